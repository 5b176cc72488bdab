"""`afspm doctor`: says what is wrong with an experiment, from any of its computers, and what to do about it."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.cli.arguments import RUNS, Files, Runs, opt

if TYPE_CHECKING:
    from afspm.supervisor.doctor import Examination

_COLOURS = {"fine": "green", "warning": "yellow", "error": "bold red"}


def doctor(
    files: Files,
    runs: Runs = RUNS,
    listen: Annotated[float, opt("For how long (s) to listen to what is published.", "--listen", min=0.1)] = 3.0,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """Say what is wrong with an experiment, seen from this computer, and what to do about it.

    Looks at names, ports, keys, clocks, versions, disk and memory, and at what the scheduler publishes. It works before
    the experiment runs, while it runs, and when a part of it does not. Ends with 1 if something keeps it from working.
    """
    from afspm.experiment import load
    from afspm.supervisor.doctor import examine

    examined = examine(load(*files), runs, listen)
    if as_json:
        typer.echo(json.dumps(_as_json(examined), indent=2, ensure_ascii=False))
    else:
        _show(examined)
    if not examined.is_well:
        raise typer.Exit(1)


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
        told = f"heard   {heard.envelope}: {heard.rate_hz:.2g} a second, {heard.bytes_per_s / 1000:.3g} kB/s"
        console.print(Text(told), soft_wrap=True)
