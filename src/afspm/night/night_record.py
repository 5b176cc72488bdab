"""The events of a night, saved line by line so that a restart loses nothing."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from afspm.basics.plain_data import Plain, from_json
from afspm.drawing import LEVELS, reduced
from afspm.drawing.palette import UNMEASURED
from afspm.drawing.raster import ValueRange, indices, value_range
from afspm.model import ControlMode, ControlState, Problem, Scan
from afspm.model.line_levelling import flattened
from afspm.night.bad_scans import bad_scans
from afspm.night.measurement_history import SOON_NS
from afspm.night.timeline import Span, Timeline

THUMBNAIL_PX = 64


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A small levelled image of a scan.

    Attributes:
        levels: [y, x], y upwards: indices into a colour map.
        span: the values of the first and the last colour, in `unit`.
        width_m: the width of the scan.
        height_m: the height of the scan, also with pixels that are not square.
    """

    levels: NDArray[np.uint8]
    span: ValueRange
    unit: str
    width_m: float
    height_m: float

    @property
    def kind(self) -> tuple[str, float]:
        """The unit and the width in m; thumbnails of one kind share a range of values, since they are compared."""
        return self.unit, float(f"{self.width_m:.3g}")

    @property
    def values(self) -> NDArray[np.float64]:
        """The levelled values in the steps of the colour scale; NaN at unmeasured pixels."""
        step = (self.span.high - self.span.low) / (LEVELS - 1)
        return np.where(self.levels == UNMEASURED, np.nan, self.span.low + step * self.levels)


@dataclass(frozen=True)
class Shot:
    """A scan with its times, its holder, and a thumbnail."""

    time_ns: int
    start_ns: int | None
    holder: str | None
    picture: Thumbnail


@dataclass(frozen=True)
class NightMark:
    """An action of a component, or its verdict on the scan that ended at `of_ns`."""

    time_ns: int
    by: str
    what: str
    score: float | None = None
    of_ns: int | None = None


@dataclass
class NightRecord:
    """The data of the night's picture.

    Attributes:
        routine: times at which thermal-drift was flagged in the normal course of a run; see `Overview.is_routine`.
        of_conditions: the numbers of the problems flagged by conditions.
        scans_taken: the number of scans, if `shots` is not complete.
    """

    shots: list[Shot] = field(default_factory=list)
    control: list[tuple[int, ControlState]] = field(default_factory=list)
    marks: list[NightMark] = field(default_factory=list)
    interruptions: list[int] = field(default_factory=list)
    routine: list[int] = field(default_factory=list)
    of_conditions: set[int] = field(default_factory=set)
    end_ns: int = 0
    scans_taken: int | None = None
    _known: set[str] = field(default_factory=set, repr=False)

    @classmethod
    def from_lines(cls, lines: Iterable[str]) -> NightRecord:
        """Return a record from the lines of its entries; a line that is not an entry is skipped."""
        record = cls()
        for line in lines:
            try:
                entry = from_json(line)
                record.add(entry)
            except (ValueError, KeyError, TypeError):
                continue
        return record

    def add(self, entry: Plain) -> bool:
        """Add an entry; return False for a known entry (packets are replayed after a restart).

        Raises:
            ValueError, KeyError, TypeError: the entry is malformed or of an unknown kind.
        """
        kind, time_ns = entry["kind"], int(entry["time_ns"])
        identity = f"{kind} {time_ns} {entry.get('by', '')}{entry.get('problem', '')}"
        if identity in self._known:
            return False
        if kind == "scan":
            levels = np.frombuffer(base64.b64decode(entry["picture"]), np.uint8).reshape(entry["shape"])
            span = ValueRange(*entry["span"])
            width_m = entry["width_m"]
            # an entry that an earlier version wrote before a resume has no height: its pixels count as squares
            height_m = entry.get("height_m", width_m * levels.shape[0] / levels.shape[1])
            picture = Thumbnail(levels, span, entry["unit"], width_m, height_m)
            self.shots.append(Shot(time_ns, entry["start_ns"], entry["holder"], picture))
        elif kind == "control":
            state = ControlState(ControlMode(entry["mode"]), entry["holder"], tuple(entry["problems"]))
            self.control.append((time_ns, state))
        elif kind == "mark":
            self.marks.append(NightMark(time_ns, entry["by"], entry["what"], entry["score"], entry["of_ns"]))
        elif kind == "interrupted":
            self.interruptions.append(time_ns)
        elif kind == "routine":
            self.routine.append(time_ns)
        elif kind == "condition":
            self.of_conditions.add(int(entry["problem"]))
        else:
            raise ValueError(kind)
        self._known.add(identity)
        self.end_ns = max(self.end_ns, time_ns)
        return True

    @property
    def start_ns(self) -> int:
        """The start of the first scan or of the first control, if earlier; `end_ns` without both."""
        times = [shot.start_ns or shot.time_ns for shot in self.shots] + [t for t, s in self.control if s.holder]
        return min(times, default=self.end_ns)

    @property
    def scans(self) -> int:
        return len(self.shots) if self.scans_taken is None else self.scans_taken

    @property
    def holders(self) -> list[str]:
        """All holders in the order of their first control."""
        return list(dict.fromkeys(state.holder for _, state in sorted_by_time(self.control) if state.holder))

    @property
    def problems(self) -> list[int]:
        """All non-routine problems, in the order of their first flag."""
        found = dict.fromkeys(p for _, state in sorted_by_time(self.control) for p in state.problems)
        return [problem for problem in found if self.problem_spans(problem)]

    def holder_of(self, shot: Shot) -> str | None:
        """Return the holder at the start of a scan; at its end if the start was not observed."""
        if shot.start_ns is not None:
            return shot.holder
        before = [state for time_ns, state in sorted_by_time(self.control) if time_ns < shot.time_ns]
        return before[-1].holder if before else None

    def control_spans(self, holder: str) -> list[Span]:
        return self._spans(lambda state: state.holder == holder, holder)

    def problem_spans(self, problem: int) -> list[Span]:
        """Return the spans in which a problem was flagged, except routine spans."""
        spans = self._spans(lambda state: problem in state.problems)
        if problem != Problem.THERMAL_DRIFT:
            return spans
        return [span for span in spans if all(abs(span.start_ns - ns) > SOON_NS for ns in self.routine)]

    def manual_spans(self) -> list[Span]:
        return self._spans(lambda state: state.mode is ControlMode.MANUAL)

    def bad_ns(self) -> frozenset[int]:
        verdicts = [(m.of_ns, m.score) for m in self.marks if m.of_ns is not None and m.score is not None]
        flagged_ns = {number: [span.start_ns for span in self.problem_spans(number)] for number in self.problems}
        times_ns = [shot.time_ns for shot in self.shots]
        return bad_scans(times_ns, verdicts, flagged_ns, self.interruptions, self.of_conditions)

    def _spans(self, holds: Callable[[ControlState], bool], label: str = "") -> list[Span]:
        timeline = Timeline()
        for time_ns, state in sorted_by_time(self.control):
            timeline.change(label if holds(state) else None, time_ns)
        return list(timeline.spans)


def sorted_by_time(control: list[tuple[int, ControlState]]) -> list[tuple[int, ControlState]]:
    return sorted(control, key=lambda pair: pair[0])


def scan_entry(scan: Scan, time_ns: int, start_ns: int | None, holder: str | None) -> dict[str, object]:
    picture = thumbnail(scan)
    return {
        "kind": "scan",
        "time_ns": time_ns,
        "start_ns": start_ns,
        "holder": holder,
        "shape": list(picture.levels.shape),
        "picture": base64.b64encode(picture.levels.tobytes()).decode(),
        "span": [picture.span.low, picture.span.high],
        "unit": picture.unit,
        "width_m": picture.width_m,
        "height_m": picture.height_m,
    }


def control_entry(state: ControlState, time_ns: int) -> dict[str, object]:
    problems = list(state.problems)
    return {
        "kind": "control",
        "time_ns": time_ns,
        "mode": int(state.mode),
        "holder": state.holder,
        "problems": problems,
    }


def mark_entry(
    by: str, what: str, time_ns: int, score: float | None = None, of_ns: int | None = None
) -> dict[str, object]:
    return {"kind": "mark", "time_ns": time_ns, "by": by, "what": what, "score": score, "of_ns": of_ns}


def thumbnail(scan: Scan, largest_px: int = THUMBNAIL_PX) -> Thumbnail:
    small = flattened(reduced(scan.values, largest_px, each_side=True))
    span = value_range(small)
    return Thumbnail(indices(small, span), span, scan.unit, *scan.region.size_m)
