"""`afspm runs`, `probes`, `report` and `export`: list recorded runs, and use one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import counted, day_and_time, duration_text, quantity
from afspm.cli.arguments import RUNS, Quiet, RecordedRun, Where, opt

if TYPE_CHECKING:
    from rich.table import Table

    from afspm.night.catalogue import ProbeHistory, RunSummary


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
    """List all runs under a folder, the newest first, or only the runs with the words that you give.

    An index is kept in runs.sqlite beside the runs; delete it at any time.
    """
    from afspm.night.catalogue import find_runs

    found = find_runs(folder, words or (), since and since.date(), until and until.date())
    if as_json:
        import json
        from dataclasses import asdict

        typer.echo(json.dumps([asdict(run) for run in found], indent=2, ensure_ascii=False))
    elif page:
        from afspm.report.catalogue_page import write_page

        typer.echo(write_page(folder, found))
    elif not found:
        typer.echo("no run was found")
    else:
        from afspm.cli.joining import plain_console

        plain_console().print(_table(found))


def _table(found: Sequence[RunSummary]) -> Table:
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


def report(where: Where = RUNS, quiet: Quiet = False) -> None:
    """Write report.html, and figures, into the folder of a run, from its record.

    Works during a run, too: the report then shows events up to now. The page needs no other file.
    """
    from afspm.basics.progress_line import ProgressLine
    from afspm.client.connect import find_run
    from afspm.report import write_report as write

    with ProgressLine("writing the report", quiet=quiet) as line:
        written = write(find_run(where), line.step)
    if not quiet:
        typer.echo(written)


def export(
    run: RecordedRun = RUNS,
    to: Annotated[
        str,
        typer.Option(
            metavar="FORMAT",
            help="gwy, h5 (NeXus), nc, png, csv, excel (csv with decimal commas), eln, gif and mp4 (films), documents "
            "(Bluesky), or another that `afspm doctor` lists.",
        ),
    ] = "gwy",
    out: Annotated[Path | None, opt("Where to write. Default: export in the folder of the run.", metavar="DIR")] = None,
    scans: Annotated[str | None, opt("Only these scans, by their numbers; 7-: from 7 on.", metavar="1-5,8")] = None,
    channel: Annotated[
        list[str] | None, opt("Pictures of this channel alone, by role or name; several times.", metavar="CHANNEL")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write the scans and spectra of a recorded run in another format.

    Works during a run, and for a run that was killed. Interrupted scans are included as far as they were recorded.
    """
    from afspm.basics.progress_line import ProgressLine
    from afspm.night.run import open_run
    from afspm.report.export import export as exported

    count = 0
    with open_run(run) as record, ProgressLine(f"writing {to}", quiet=quiet) as line:
        folder = out or record.folder / "export" / to
        for count, file in enumerate(
            exported(record, to, folder, scans, lambda text: line.say(f"left out: {text}"), channel or ()), 1
        ):
            line.step(f"{count} files, {file.name}")
    if not quiet:
        typer.echo(f"{counted(count, 'file')} in {folder}")


def probes(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[WORD…]", help="Only runs with all of these, as for `afspm runs`; probe:NAME.", show_default=False
        ),
    ] = None,
    folder: Annotated[Path, typer.Option("--in", metavar="DIR", help="The folder to look in.")] = RUNS,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """List probes with the metres that they have scanned, their treatments and the verdicts on them.

    The name of a probe is `probe` in [metadata] of the experiment file.
    """
    from afspm.night.catalogue import find_runs, probe_histories

    found = probe_histories(find_runs(folder, words or ()))
    if as_json:
        import json
        from dataclasses import asdict

        typer.echo(json.dumps([asdict(probe) for probe in found], indent=2, ensure_ascii=False))
    elif not found:
        typer.echo("no run was found")
    else:
        from afspm.cli.joining import plain_console, plain_table

        rows = ([text(probe) for text in _PROBE_COLUMNS.values()] for probe in found)
        plain_console().print(plain_table(_PROBE_COLUMNS, rows))


def _day(time_ns: int | None) -> str:
    return "" if time_ns is None else day_and_time(time_ns, UTC, seconds=False).removesuffix(" UTC")


def _name(probe: ProbeHistory) -> str:
    return (probe.name or "(not named)") + (" SIMULATED" if probe.simulated else "")


_PROBE_COLUMNS: Final[dict[str, Callable[[ProbeHistory], str]]] = {
    "probe": _name,
    "first used (UTC)": lambda probe: _day(probe.first_ns),
    "last used (UTC)": lambda probe: _day(probe.last_ns),
    "runs": lambda probe: str(len(probe.runs)),
    "scanned": lambda probe: f"{quantity(probe.scanned_m, 'm', 3)} in {counted(probe.scans, 'scan')}",
    "spectra": lambda probe: str(probe.spectra),
    "treatments": lambda probe: ", ".join(f"{count} × {name}" for name, count in probe.treatments.items()),
    "runs with a problem": lambda probe: str(probe.flagged),
    "good scans": lambda probe: f"{probe.good} of {probe.judged} judged" if probe.judged else "",
}
