"""`afspm runs`: all runs under a folder, searched and listed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import day_and_time, duration_text
from afspm.cli.arguments import RUNS, opt

if TYPE_CHECKING:
    from rich.table import Table

    from afspm.record.catalogue import RunSummary

_DAYS = ["%Y-%m-%d"]


def runs(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[WORD…]",
            help="Only runs with all of these: in any field, or as sample:gold, person:, problem:, note: … in one.",
            show_default=False,
        ),
    ] = None,
    folder: Annotated[Path, typer.Option("--in", metavar="DIR", help="The folder to look in.")] = RUNS,
    since: Annotated[datetime | None, opt("Only runs on this day (UTC) or later.", formats=_DAYS)] = None,
    until: Annotated[datetime | None, opt("Only runs on this day (UTC) or earlier.", formats=_DAYS)] = None,
    page: Annotated[bool, typer.Option("--page", help="Write index.html, with pictures, into the folder.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """List all runs under a folder, the newest first, or those with the words that you give.

    An index is kept in runs.sqlite beside the runs; delete it at any time.
    """
    from afspm.record.catalogue import find_runs

    found = find_runs(folder, words or (), since and since.date(), until and until.date())
    if as_json:
        import json
        from dataclasses import asdict

        typer.echo(json.dumps([asdict(run) for run in found], indent=2, ensure_ascii=False))
    elif page:
        from afspm.record.catalogue_page import write_page

        typer.echo(write_page(folder, found))
    elif not found:
        typer.echo("no run was found")
    else:
        from afspm.cli.joining import plain_console

        plain_console().print(_table(found))


def _table(found: Sequence[RunSummary]) -> Table:
    """Return a row for each run, without columns of which nothing is known."""
    from rich import box
    from rich.table import Table

    columns = {head: [text(run) for run in found] for head, text in _COLUMNS.items()}
    shown = {head: texts for head, texts in columns.items() if any(texts)}
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for head in shown:
        table.add_column(head, no_wrap=head in ("run", "began (UTC)"), overflow="fold")
    for row in zip(*shown.values(), strict=True):
        table.add_row(*row)
    return table


def _began(run: RunSummary) -> str:
    return "" if run.began_ns is None else day_and_time(run.began_ns, UTC, seconds=False).removesuffix(" UTC")


def _lasted(run: RunSummary) -> str:
    if run.began_ns is None or run.ended_ns is None:
        return ""
    return duration_text((run.ended_ns - run.began_ns) / NS_PER_S)


_COLUMNS: Final[dict[str, Callable[[RunSummary], str]]] = {
    "run": lambda run: run.folder,
    "began (UTC)": _began,
    "lasted": _lasted,
    "sample": lambda run: run.metadata.get("sample", ""),
    "person": lambda run: run.metadata.get("person", ""),
    "microscope": lambda run: "simulated" if run.simulated else run.microscope,
    "measured": lambda run: run.measured,
    "problems": lambda run: run.damage or ", ".join(run.problems),
}
