"""Record of a survey: its targets and the measurements at each target, as a table and a picture."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from afspm.components.surveying.targets import Target
from afspm.model import RegistrationOutcome, Scan, Spectrum
from afspm.model.geometry import XY
from afspm.storage.atomic import write_atomic


class Outcome(Enum):
    """Outcome of the visit to a target."""

    MEASURED = "measured"
    REFUSED = "refused"
    """The zoom or a curve was refused; the table has the reason."""
    INCOMPLETE = "incomplete"
    """The survey ended before the last curve."""
    NOT_REACHED = "not-reached"


@dataclass(eq=False)
class Visit:
    """A target with its measurements.

    Attributes:
        number: counts from 1, in the order of the targets.
        center_m: (x, y), the origin of the offsets of curves: the target's position in its zoom; before the zoom, in
            the survey.
        zoom: the scan of the target; None: not taken, or not yet.
        curves: the measured curves, by name.
        refusals: reasons of refusals.
        registration: source of the zoom's position on the sample; None without drift correction.
        position_sd_m: standard deviation of that position; None: unknown.
    """

    number: int
    target: Target
    center_m: XY
    zoom: Scan | None = None
    curves: dict[str, Spectrum] = field(default_factory=dict)
    refusals: list[str] = field(default_factory=list)
    registration: RegistrationOutcome | None = None
    position_sd_m: float | None = None


class SurveyRecord:
    """A wide scan, and a visit for each target in it.

    Args:
        survey: the wide scan.
        targets: the targets in the order of their visits.
        curves: names of the curves of each target.

    Attributes:
        visits: a visit for each target; to be filled in as the targets are measured.
    """

    def __init__(self, survey: Scan, targets: Sequence[Target], curves: Sequence[str] = ()) -> None:
        self.survey = survey
        self.curves = tuple(curves)
        self.visits = [Visit(number, target, target.position_m) for number, target in enumerate(targets, start=1)]

    def outcome(self, visit: Visit) -> Outcome:
        """Return the outcome of a visit."""
        if visit.refusals:
            return Outcome.REFUSED
        if visit.zoom is None:
            return Outcome.NOT_REACHED
        return Outcome.MEASURED if visit.curves.keys() >= set(self.curves) else Outcome.INCOMPLETE

    def write(self, path: str | Path) -> None:
        """Write the table: a row for each target, with the controller's files of its zoom and curves.

        If drift is corrected, `registration` and `position_sd` are the source and the standard deviation of a zoom's
        position: registered, coarse, or by dead reckoning (refused, failed, new). Paths of files in the table's folder
        are relative.

        Raises:
            FileError: the table can't be written.
        """
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(self._rows(Path(path).absolute().parent))
        write_atomic(Path(path), [text.getvalue().encode()])

    def _rows(self, folder: Path) -> Iterator[list[str]]:
        yield [
            "number", "x", "y", "position_sd", "length_units", "registration", "height", "height_units", "outcome",
            "reason", "zoom", *self.curves,
        ]  # fmt: skip
        for visit in self.visits:
            height = visit.target.height
            yield [
                str(visit.number),
                *(f"{value:.9g}" for value in visit.center_m),
                "" if visit.position_sd_m is None else f"{visit.position_sd_m:.3g}",
                "m",
                visit.registration.label if visit.registration else "",
                *(("", "") if height is None else (f"{height:.6g}", self.survey.unit)),
                self.outcome(visit).value,
                "; ".join(visit.refusals),
                _within(visit.zoom, folder),
                *(_within(visit.curves.get(name), folder) for name in self.curves),
            ]


def _within(measured: Scan | Spectrum | None, folder: Path) -> str:
    if measured is None or not measured.filename:
        return ""
    file = Path(measured.filename)
    return file.relative_to(folder).as_posix() if file.is_relative_to(folder) else measured.filename
