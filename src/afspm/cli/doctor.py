"""`afspm doctor`: find the faults of an experiment from any of its computers, with remedies."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection
from typing import TYPE_CHECKING, Annotated

import typer
from typer.core import TyperGroup

from afspm.cli.arguments import RUNS, OptionalFiles, Runs, opt

if TYPE_CHECKING:
    from afspm.cli.examination import Examination

_COLOURS = {"fine": "green", "warning": "yellow", "error": "bold red"}


def doctor(
    context: typer.Context,
    files: OptionalFiles = None,
    runs: Runs = RUNS,
    listen: Annotated[float, opt("Seconds to listen to published packets.", "--listen", min=0.1)] = 3.0,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """Find the faults of an experiment, seen from this computer, with remedies.

    Checks names, ports, keys, clocks, versions, disk and memory, and the packets of the scheduler. Works before the
    experiment runs, while it runs, and when a part of it does not. Lists the drivers, components, readers … of all
    installed packages, with the reason where one can't be loaded. Without a file it checks this computer alone. Ends
    with 1 if something keeps the experiment from working.
    """
    from afspm.cli.examination import examine
    from afspm.experiment import load

    examined = examine(load(*files) if files else None, runs, listen, _commands(context))
    if as_json:
        typer.echo(json.dumps(_as_json(examined), indent=2, ensure_ascii=False))
    else:
        _show(examined)
    if not examined.is_well:
        raise typer.Exit(1)


def _commands(context: typer.Context) -> Collection[str]:
    root = context.find_root().command
    return root.commands.keys() if isinstance(root, TyperGroup) else ()


def _as_json(examined: Examination) -> dict[str, object]:
    found = [{**dataclasses.asdict(one), "severity": one.severity.value} for one in examined.found]
    heard = [{**dataclasses.asdict(one), "rate_hz": one.rate_hz} for one in examined.heard]
    return {"is_well": examined.is_well, "found": found, "heard": heard}


def _show(examined: Examination) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)
    for one in examined.found:
        word = one.severity.value
        line = Text.assemble((f"{word:8}", _COLOURS[word]), (one.where, "bold"), f": {one.what}")
        if one.remedy:
            line.append(f"\n        {one.remedy}", "dim")
        console.print(line, soft_wrap=True)
    for heard in examined.heard:
        told = f"packets {heard.envelope}: {heard.rate_hz:.2g} a second, {heard.bytes_per_s / 1000:.3g} kB/s"
        console.print(Text(told), soft_wrap=True)
