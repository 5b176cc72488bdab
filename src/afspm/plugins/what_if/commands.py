"""`afspm what-if`: replay recorded nights with a changed setting, class or version."""

from __future__ import annotations

import json
import sys
import tomllib
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from afspm.basics.clock import iso_utc
from afspm.basics.formatting import counted, day_and_time
from afspm.cli.arguments import AFTERWARDS, names_in, opt

if TYPE_CHECKING:
    from afspm.plugins.what_if.alignment import Difference, Output
    from afspm.plugins.what_if.what_if import WhatIf

DIFFERS = 3
"""Exit code: a night differs."""
_MOST_SHOWN = 10
_LONGEST, _AROUND = 120, 25
app = typer.Typer(add_completion=False, rich_markup_mode="markdown", rich_help_panel=AFTERWARDS)


@app.command()
def what_if(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN… [CHANGED]",
            help="Folders of runs, and the changed experiment file (.toml), which needs to hold only what differs. "
            "Without it the runs are replayed as they were, by the installed version.",
            show_default=False,
        ),
    ],
    component: Annotated[
        list[str] | None, opt("Replay only this component; may be repeated.", "--component", metavar="NAME")
    ] = None,
    change: Annotated[
        list[str] | None,
        opt("Change one setting, e.g. classifier.sigmas=4.0; may be repeated.", "--set", metavar="NAME.KEY=VALUE"),
    ] = None,
    closed: Annotated[
        bool, opt("Run simulated nights again with the change, to their end, and compare the outcomes.", "--closed")
    ] = False,
    runs: Annotated[Path, typer.Option("--runs", metavar="DIR", help="Where --closed makes the new runs.")] = Path(
        "runs"
    ),
    as_json: Annotated[bool, opt("For programs.", "--json")] = False,
) -> None:
    """Replay recorded nights with a change, and show the differences.

    Each component gets its recorded packets and answers again, and its outputs are compared with the recorded ones.
    Needs runs with `requests = true` in [record]. Exit code 3: a night differs.
    """
    folders, changes = _given(paths, change or [])
    differs = False
    for folder in folders:
        if closed:
            differs |= _rerun(folder, changes, runs)
        else:
            differs |= _replay(folder, changes, names_in(component), as_json=as_json)
    if differs:
        raise typer.Exit(DIFFERS)


def _given(paths: list[Path], change: list[str]) -> tuple[list[Path], Any]:
    files = [path for path in paths if path.suffix == ".toml"]
    folders = [path for path in paths if path.suffix != ".toml"]
    if not folders:
        raise typer.BadParameter("name the folder of a run", param_hint="RUN")
    if len(files) > 1:
        raise typer.BadParameter("one changed file at a time", param_hint="CHANGED")
    if files and change:
        raise typer.BadParameter("write it into the changed file, too", param_hint="--set")
    if files:
        return folders, files[0]
    changes: dict[str, dict[str, Any]] = {}
    for text in change:
        place, _, value = text.partition("=")
        name, _, key = place.partition(".")
        if not (name and key and value):
            raise typer.BadParameter(f"{text!r} is not NAME.KEY=VALUE", param_hint="--set")
        changes.setdefault(name.strip(), {})[key.strip()] = _value(value.strip())
    return folders, changes or None


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text  # a text without its quotes


def _replay(folder: Path, changes: Any, only: tuple[str, ...], *, as_json: bool) -> bool:
    from afspm.plugins.what_if.what_if import what_if

    result = what_if(folder, changes, only=only)
    if as_json:
        typer.echo(json.dumps(_facts(result), ensure_ascii=False))
    else:
        _print(result)
    return result.differs


def _rerun(folder: Path, changes: Any, runs: Path) -> bool:
    from afspm.cli.joining import plain_console, plain_table
    from afspm.plugins.what_if.closed_loop import rerun

    found = rerun(folder, changes or {}, runs=runs, terminal=sys.stderr)
    typer.echo(f"{folder.name} and, with the change, {found.folder.name} (SIMULATED)")
    rows = [[head, *texts] for head, texts in found.rows.items()]
    plain_console().print(plain_table(["", "recorded", "now"], rows))
    return found.differs


def _print(result: WhatIf) -> None:
    from afspm.cli.joining import plain_console, plain_table

    first = result.first
    typer.echo(f"{result.run.name}: {'differs' if first else 'no difference'}")
    if first is not None:
        typer.echo("\n".join(_described(first)))
    if (since_ns := result.counterfactual_from_ns) is not None:
        typer.echo(
            f"after {day_and_time(since_ns, UTC)} the inputs are those of another night (counterfactual): differences "
            "of components that act are not counted from there on"
        )
    heads = ("process", "same", "added", "removed", "changed", "counterfactual", "")
    rows = [
        [row.name, *map(str, (row.same, row.added, row.removed, row.changed, row.counterfactual)), row.note]
        for row in result.table()
    ]
    plain_console().print(plain_table(heads, rows))
    shown = result.differences
    for one in shown[1:_MOST_SHOWN]:
        mark = " (counterfactual)" if one.counterfactual else ""
        sides = " → ".join(_sides(one))
        typer.echo(f"{day_and_time(one.at_ns, UTC)}  {one.component}: {sides}{mark}")
    if len(shown) > _MOST_SHOWN:
        typer.echo(f"and {counted(len(shown) - _MOST_SHOWN, 'more difference')}")
    for name, hazards in result.hazards.items():
        for hazard in hazards:
            typer.echo(f"{name} depends on more than its inputs: it {hazard}")
    for name, why in result.unread.items():
        typer.echo(f"{name} was not replayed: {why}", err=True)


def _described(first: Difference) -> list[str]:
    packet = first.packet
    at = f"{day_and_time(first.at_ns, UTC)}, at the packet {packet.envelope}" if packet else "before the first packet"
    recorded, now = _sides(first)
    return [f"first difference: {first.component}, {at}", f"  recorded  {recorded}", f"  now       {now}"]


def _sides(one: Difference) -> tuple[str, str]:
    if one.recorded is None or one.now is None:
        return _side(one.recorded), _side(one.now)
    before, after = one.recorded, one.now
    if before.value == after.value:
        return _side(before), f"the same, at another packet: {_place(after)}"
    # of long messages the part that differs
    if min(len(before.text), len(after.text)) <= _LONGEST:
        return _side(before), _side(after)
    pairs = enumerate(zip(before.text, after.text, strict=False))
    common = next((at for at, (one, other) in pairs if one != other), 0)
    since, until = max(0, common - _AROUND), common + _AROUND
    return _side(before, since, until), _side(after, since, until)


def _side(output: Output | None, since: int = 0, until: int = 120) -> str:
    if output is None:
        return "nothing"
    text = f"{'…' if since else ''}{output.text[since:until]}{'…' if until < len(output.text) else ''}"
    return text if output.reaches else f"{output.key or output.message}: {text}"


def _place(output: Output) -> str:
    packet = output.packet
    return "none" if packet is None else f"{packet.envelope} of {day_and_time(packet.time_ns, UTC)}"


def _facts(result: WhatIf) -> dict[str, Any]:
    def side(output: Output | None) -> dict[str, str] | None:
        return None if output is None else {"message": output.message, "key": output.key, "text": output.text}

    def difference(one: Difference) -> dict[str, Any]:
        return {
            "component": one.component,
            "at": iso_utc(one.at_ns),
            "packet": None if one.packet is None else {"time_ns": one.packet.time_ns, "envelope": one.packet.envelope},
            "kind": one.kind,
            "recorded": side(one.recorded),
            "now": side(one.now),
            "counterfactual": one.counterfactual,
        }

    since_ns = result.counterfactual_from_ns
    return {
        "run": result.run.name,
        "differs": result.differs,
        "first": None if result.first is None else difference(result.first),
        "counterfactual_from": None if since_ns is None else iso_utc(since_ns),
        "table": [vars(row) for row in result.table()],
        "differences": [difference(one) for one in result.differences],
        "hazards": result.hazards,
        "not_replayed": result.unread,
    }
