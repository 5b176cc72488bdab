"""The comparison of a run's planned and measured work."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from afspm.basics.clock import NS_PER_S
from afspm.model.planned_work import PlannedWork, path_length_m
from afspm.night.tables import ScanRow, SpectrumRow


@dataclass(frozen=True)
class WorkComparison:
    """The planned and the measured work of a component.

    The measured duration extends from the start of the first to the end of the last scan or spectrum, with pauses.
    """

    name: str
    planned: PlannedWork
    measured: PlannedWork


def compare(
    planned: Mapping[str, PlannedWork | None], scans: Iterable[ScanRow], spectra: Iterable[SpectrumRow]
) -> list[WorkComparison]:
    """Return the comparison of each component with a plan.

    Args:
        planned: the planned work by component; None: no estimate.
        scans, spectra: all scans and spectra of the run; each counts for the component in control at its start.
            Interrupted scans do not count.
    """
    all_scans, all_spectra = list(scans), list(spectra)
    return [
        WorkComparison(
            name,
            plan,
            _measured(
                [scan for scan in all_scans if scan.holder == name and not scan.interrupted],
                [spectrum for spectrum in all_spectra if spectrum.holder == name],
            ),
        )
        for name, plan in planned.items()
        if plan is not None
    ]


def _measured(scans: list[ScanRow], spectra: list[SpectrumRow]) -> PlannedWork:
    rows: list[ScanRow | SpectrumRow] = [*scans, *spectra]
    began_ns = min((row.time_ns if row.began_ns is None else row.began_ns for row in rows), default=0)
    lasted_ns = max((row.time_ns for row in rows), default=0) - began_ns
    seen = [(scan.region, scan.shape) for scan in scans if scan.region is not None and scan.shape is not None]
    return PlannedWork(
        scans=len(scans),
        spectra=len(spectra),
        path_m=sum(path_length_m(region, shape[0]) for region, shape in seen),
        pixels=sum(shape[0] * shape[1] for _, shape in seen),
        duration_s=lasted_ns / NS_PER_S,
    )
