"""`afspm what-if`: replay recorded nights with a changed setting, class or version."""

from __future__ import annotations

import json
import sys
import tomllib
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from afspm.basics import AfspmError, counted, day_and_time, iso_utc
from afspm.cli import AFTERWARDS, NoProgress, names_in, opt

if TYPE_CHECKING:
    from afspm_lab.what_if.alignment import Difference, Output
    from afspm_lab.what_if.what_if import WhatIf

DIFFERS = 3
"""Exit code: a night differs."""
INCOMPLETE = 1
"""Exit code: no night differs, but a night, or a process of a night, could not be replayed."""
_MOST_SHOWN = 10
GivenChanges: TypeAlias = dict[str, dict[str, object]] | Path | None
"""The changed experiment file, or new settings by component."""
app = typer.Typer(rich_markup_mode=None, rich_help_panel=AFTERWARDS)


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
    import_from: Annotated[
        list[Path] | None,
        opt("Import classes from this folder, too; may be repeated.", "--import-from", metavar="DIR", file_okay=False),
    ] = None,
    as_json: Annotated[bool, opt("For programs.", "--json")] = False,
    page: Annotated[
        Path | None, opt("Write the result as one HTML page, too.", "--page", metavar="FILE", dir_okay=False)
    ] = None,
    quiet: NoProgress = False,
) -> None:
    """Replay recorded nights with a change, and show the differences.

    Each component gets its recorded packets and answers again, and its outputs are compared with the recorded outputs.
    Needs runs with `requests = true` in [record]. Exit code 3: a night differs; 1: none differs, but not all could be
    replayed.
    """
    folders, changes = _given(paths, change or [])
    if page is not None:
        _require_page(page, closed=closed)
    if closed:
        differs = [_rerun(folder, changes, runs) for folder in folders]
        code = DIFFERS if any(differs) else 0
    else:
        code = _replay(folders, changes, names_in(component), page, import_from or [], as_json=as_json, quiet=quiet)
    if code:
        raise typer.Exit(code)


def _given(paths: list[Path], change: list[str]) -> tuple[list[Path], GivenChanges]:
    files = [path for path in paths if path.suffix == ".toml"]
    # `runs/*` has the newest run twice, as `latest` is a link, and files: the index of `afspm runs`
    others = (path for path in paths if path.suffix != ".toml" and not path.is_file())
    folders = [*{path.resolve(): path for path in others}.values()]
    if not folders:
        raise typer.BadParameter("name the folder of a run", param_hint="RUN")
    if len(files) > 1:
        raise typer.BadParameter("one changed file at a time", param_hint="CHANGED")
    if files and change:
        raise typer.BadParameter("write it into the changed file, too", param_hint="--set")
    if files:
        return folders, files[0]
    changes: dict[str, dict[str, object]] = {}
    for text in change:
        place, _, value = text.partition("=")
        name, _, key = place.partition(".")
        if not (name and key and value):
            raise typer.BadParameter(f"{text!r} is not NAME.KEY=VALUE", param_hint="--set")
        changes.setdefault(name.strip(), {})[key.strip()] = _value(value.strip())
    return folders, changes or None


def _value(text: str) -> object:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text  # a text without its quotes


def _require_page(page: Path, *, closed: bool) -> None:
    # before the replays: they may take an hour
    if closed:
        raise typer.BadParameter("`afspm compare` writes a page of both runs", param_hint="--page with --closed")
    if not page.parent.is_dir():
        raise typer.BadParameter(f"there is no folder {page.parent}", param_hint="--page")


def _replay(
    folders: list[Path],
    changes: GivenChanges,
    only: tuple[str, ...],
    target: Path | None,
    import_from: list[Path],
    *,
    as_json: bool,
    quiet: bool,
) -> int:
    from afspm.basics import ProgressLine
    from afspm_lab.what_if.page import DifferencePage
    from afspm_lab.what_if.what_if import what_if

    page, differs, is_whole = DifferencePage(changes), False, True
    for folder in folders:
        try:
            with ProgressLine(folder.name, quiet=quiet) as line:
                result = what_if(folder, changes, only=only, import_from=import_from, step=line.step)
        except AfspmError as error:
            if len(folders) == 1:
                raise
            # the other nights are replayed all the same: they may take an hour
            is_whole = False
            page.add_unread(folder.name, str(error))
            typer.echo(f"{folder.name} was not replayed: {error}", err=True)
            continue
        differs |= result.differs
        is_whole &= not result.unread
        if as_json:
            typer.echo(json.dumps(_facts(result), ensure_ascii=False))
        else:
            _print(result)
        if target is not None:
            page.add(result)
    if target is not None:
        page.write(target)
        typer.echo(target, err=as_json)
    return DIFFERS if differs else 0 if is_whole else INCOMPLETE


def _rerun(folder: Path, changes: GivenChanges, runs: Path) -> bool:
    from afspm.cli import plain_console, plain_table
    from afspm_lab.what_if.closed_loop import rerun

    found = rerun(folder, changes or {}, runs=runs, terminal=sys.stderr)
    typer.echo(f"{folder.name} and, with the change, {found.folder.name} (SIMULATED)")
    rows = [[head, *texts] for head, texts in found.rows.items()]
    plain_console().print(plain_table(["", "recorded", "now"], rows))
    return found.differs


def _print(result: WhatIf) -> None:
    from afspm.cli import plain_console, plain_table
    from afspm_lab.what_if.side_by_side import sides, where

    first = result.first
    typer.echo(f"{result.run.name}: {'differs' if first else 'no difference'}")
    if first is not None:
        recorded, now = sides(first)
        typer.echo(f"first difference: {first.component}, {where(first)}")
        typer.echo(f"  recorded  {recorded}\n  now       {now}")
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
        typer.echo(f"{day_and_time(one.at_ns, UTC)}  {one.component}: {' → '.join(sides(one))}{mark}")
    if len(shown) > _MOST_SHOWN:
        typer.echo(f"and {counted(len(shown) - _MOST_SHOWN, 'more difference')}")
    for name, hazards in result.hazards.items():
        for hazard in hazards:
            typer.echo(f"{name} depends on more than its inputs: it {hazard}")
    for name, why in result.unread.items():
        typer.echo(f"{name} was not replayed: {why}", err=True)
    for why in sorted({*result.left_out.values()}):
        names = sorted(name for name, reason in result.left_out.items() if reason == why)
        typer.echo(f"left out: {', '.join(names)}: {why}", err=True)
    for name, why in result.untried.items():
        typer.echo(f"[{name}] {why}", err=True)


def _facts(result: WhatIf) -> dict[str, object]:
    def side(output: Output | None) -> dict[str, str] | None:
        return None if output is None else {"message": output.message, "key": output.key, "text": output.text}

    def difference(one: Difference) -> dict[str, object]:
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
        "left_out": result.left_out,
        "not_tried": result.untried,
    }
