"""`afspm probes`: the history of each probe over all recorded nights."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from afspm.basics.formatting import counted, day_and_time, quantity
from afspm.cli.arguments import RUNS

if TYPE_CHECKING:
    from afspm.record.probes import ProbeHistory


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
    from afspm.record.catalogue import find_runs
    from afspm.record.probes import probe_histories

    found = probe_histories(find_runs(folder, words or ()))
    if as_json:
        import json
        from dataclasses import asdict

        typer.echo(json.dumps([asdict(probe) for probe in found], indent=2, ensure_ascii=False))
    elif not found:
        typer.echo("no run was found")
    else:
        from afspm.cli.joining import plain_console, plain_table

        rows = ([text(probe) for text in _COLUMNS.values()] for probe in found)
        plain_console().print(plain_table(_COLUMNS, rows))


def _day(time_ns: int | None) -> str:
    return "" if time_ns is None else day_and_time(time_ns, UTC, seconds=False).removesuffix(" UTC")


def _name(probe: ProbeHistory) -> str:
    return (probe.name or "(not named)") + (" SIMULATED" if probe.simulated else "")


_COLUMNS: Final[dict[str, Callable[[ProbeHistory], str]]] = {
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
