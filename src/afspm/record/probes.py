"""The history of each probe over all recorded nights: how far it has scanned, how it was treated, how it was judged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from afspm.record.catalogue import RunSummary

UNNAMED = ""
"""The name of the probe in runs whose [metadata] names none."""


@dataclass(frozen=True)
class ProbeHistory:
    """One probe.

    Attributes:
        name: of [metadata] `probe`; `UNNAMED` for all runs without one, which may be several probes.
        runs: their folders, oldest first.
        first_ns, last_ns: begin of the first and end of the last run, in experiment time; None: not known.
        scans, spectra: numbers of whole ones.
        scanned_m: the path along scan lines, trace and retrace, in metres.
        treatments: how often each was executed, by the name of its action.
        flagged: in how many runs a problem was flagged.
        judged, good: scans with a verdict on the tip, and those with a good one.
        simulated: whether all runs were simulated.
    """

    name: str
    runs: tuple[str, ...]
    first_ns: int | None
    last_ns: int | None
    scans: int
    spectra: int
    scanned_m: float
    treatments: Mapping[str, int]
    flagged: int
    judged: int
    good: int
    simulated: bool


def probe_histories(runs: Iterable[RunSummary]) -> list[ProbeHistory]:
    """Return a history for each probe, the one used last first. Damaged runs are left out."""
    by_probe: dict[str, list[RunSummary]] = {}
    for run in sorted(runs, key=lambda run: (run.began_ns or 0, run.folder)):
        if not run.damage:
            by_probe.setdefault(run.metadata.get("probe", UNNAMED), []).append(run)
    histories = [_history(name, used) for name, used in by_probe.items()]
    return sorted(histories, key=lambda probe: probe.last_ns or 0, reverse=True)


def _history(name: str, runs: list[RunSummary]) -> ProbeHistory:
    treatments: Counter[str] = Counter()
    for run in runs:
        treatments.update(run.treatments)
    return ProbeHistory(
        name=name,
        runs=tuple(run.folder for run in runs),
        first_ns=min((run.began_ns for run in runs if run.began_ns is not None), default=None),
        last_ns=max((run.ended_ns for run in runs if run.ended_ns is not None), default=None),
        scans=sum(run.scans for run in runs),
        spectra=sum(run.spectra for run in runs),
        scanned_m=sum(run.scanned_m for run in runs),
        treatments=dict(treatments.most_common()),
        flagged=sum(bool(run.problems) for run in runs),
        judged=sum(run.judged[0] for run in runs),
        good=sum(run.judged[1] for run in runs),
        simulated=all(run.simulated for run in runs),
    )
