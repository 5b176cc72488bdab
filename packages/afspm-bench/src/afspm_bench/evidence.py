"""Evidence of a trial: record, truth and report, read from the sealed folder."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import afspm
from afspm import Run
from afspm.basics import AfspmError, InvalidValue, Plain, PlainMapping
from afspm.emulation import World
from afspm.model import ControlMode, ControlRequest, ControlResponse, JournalEntry, Region, Scan, Spectrum
from afspm.night import ScanRow, SpectrumRow
from afspm_bench.agent_folder import read_left

STATUSES: Final = ("done", "cannot", "ask")
MOST_REPORT_BYTES: Final = 1 << 20
_MOST_LEVELS: Final = 32
_LIMITED: Final = frozenset(
    {
        ControlResponse.PARAM_ERROR,
        ControlResponse.ACTION_ERROR,
        ControlResponse.FAILURE,
        ControlResponse.CMD_NOT_SUPPORTED,
    }
)
"""Responses of the scheduler to a request beyond a limit or a role."""
_ACTS: Final = frozenset(
    {
        ControlRequest.ACTION, ControlRequest.PARAM, ControlRequest.SET_SCAN_PARAMS, ControlRequest.SET_PROBE_POS,
        ControlRequest.SET_ZCTRL_PARAMS, ControlRequest.SET_CONTROL_MODE, ControlRequest.END_EXPERIMENT,
    }
)  # fmt: skip


@dataclass(frozen=True)
class Report:
    """Report of an agent, with validated fields.

    Attributes:
        cites: times of the measurements that support the answer, in ns since the Unix epoch.
        asks: names of facts missing from the prompt.
        usage: resources that the agent used, such as tokens; for the line of the trial, never judged.
        handed_in: the JSON object as the agent wrote it.
    """

    status: str
    answer: PlainMapping = field(default_factory=dict)
    cites: tuple[int, ...] = ()
    asks: tuple[str, ...] = ()
    usage: PlainMapping = field(default_factory=dict)
    handed_in: PlainMapping = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def from_plain(cls, plain: object) -> Report:
        """Return the report described by a JSON object.

        Raises:
            InvalidValue: a field is unknown or of the wrong type, or the object has more than 32 levels.
        """
        if not isinstance(plain, dict) or plain.get("status") not in STATUSES:
            raise InvalidValue(f"a report needs a status of {', '.join(STATUSES)}")
        if unknown := sorted(set(plain) - {"status", "answer", "cites", "asks", "usage"}):
            raise InvalidValue(f"a report has no field {unknown[0]!r}")
        if _levels(plain) > _MOST_LEVELS:  # more would end the functions that copy and compare it
            raise InvalidValue(f"a report has {_MOST_LEVELS} levels at most, of objects and lists within another")
        answer, cites, asks = plain.get("answer", {}), plain.get("cites", []), plain.get("asks", [])
        usage = plain.get("usage", {})
        # an id over HTTP is a text, since it has more digits than a JSON number holds in some languages
        if not (
            isinstance(answer, dict) and isinstance(cites, list) and isinstance(asks, list) and isinstance(usage, dict)
        ):
            raise InvalidValue("answer and usage are objects, cites and asks are lists")
        try:
            times = tuple(int(one) for one in cites)
        except (TypeError, ValueError, OverflowError) as error:  # OverflowError: infinity, which Python's JSON reads
            raise InvalidValue(f"cites are times in ns: {error}") from error
        return cls(str(plain["status"]), answer, times, tuple(map(str, asks)), usage, plain)

    def as_plain(self) -> dict[str, object]:
        """Return the report as a dict for the line of the trial, without its cites."""
        return {"status": self.status, "answer": self.answer, "asks": list(self.asks), "usage": self.usage}

    def number(self, *keys: str | int) -> float:
        """Return a number in the answer, found by keys and indices; NaN if the entry is missing or not a number."""
        found: Any = self.answer
        try:
            for key in keys:
                found = found[key]
            return float(found) if not isinstance(found, bool) else math.nan
        except (KeyError, IndexError, TypeError, ValueError, OverflowError):
            return math.nan

    def value(self, name: str) -> tuple[float, float]:
        """Return the value and the error of a reported quantity; NaN for a missing number."""
        return self.number(name, "value"), self.number(name, "error")


@dataclass
class Evidence:
    """Record, truth and report of a trial, for its judge.

    Attributes:
        folder: folder of the run.
        bench: name under which the bench itself sends requests.
        report: the agent's report; None if missing or invalid.
        began_ns: experiment time of the agent's start.
        final: parameters of the microscope at the end, in SI units.
    """

    folder: Path
    bench: str
    report: Report | None
    began_ns: int
    final: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def run(self) -> Run:
        return afspm.open_run(self.folder)

    # --- the record ---

    @cached_property
    def requests(self) -> list[JournalEntry]:
        """Requests of the agent, under any name other than the bench's."""
        return [one for one in self.run.journal if one.kind == "request" and one.who != self.bench]

    @cached_property
    def hazards(self) -> list[JournalEntry]:
        """Requests of the agent for a change that a limit or a role refused before the microscope got them."""
        return [one for one in self.acts if one.refused and one.sent_ns is None and one.response in _LIMITED]

    @cached_property
    def acts(self) -> list[JournalEntry]:
        """Requests of the agent for a change of the microscope, the mode or the experiment, refused or not."""
        return [one for one in self.requests if one.request in _ACTS]

    @cached_property
    def scans(self) -> list[ScanRow]:
        """Complete scans."""
        return [row for row in self.run.scans if not row.interrupted and row.region is not None]

    @cached_property
    def spectra(self) -> list[SpectrumRow]:
        return [row for row in self.run.spectra if row.position_m is not None]

    @cached_property
    def cited_scans(self) -> list[ScanRow]:
        cites = self.report.cites if self.report else ()
        return [row for row in self.scans if row.time_ns in cites]

    @cached_property
    def cited_spectra(self) -> list[SpectrumRow]:
        cites = self.report.cites if self.report else ()
        return [row for row in self.spectra if row.time_ns in cites]

    def heights(self, row: ScanRow) -> Scan:
        return self.run.scan(row)["height"]

    def curve(self, row: SpectrumRow) -> Spectrum:
        return self.run.spectrum(row)

    def settings(self, row: ScanRow | SpectrumRow) -> PlainMapping:
        """Return the microscope's parameters during a measurement, by the names in the recorded file."""
        return self.run.about(row)

    def manual(self) -> list[tuple[int, int]]:
        """Return the periods of the control mode MANUAL, as (start, end) in ns."""
        spans: list[tuple[int, int]] = []
        for row in self.run.control:
            is_manual = row.state.mode is ControlMode.MANUAL
            if is_manual and (not spans or spans[-1][1] >= 0):
                spans.append((row.time_ns, -1))
            elif not is_manual and spans and spans[-1][1] < 0:
                spans[-1] = (spans[-1][0], row.time_ns)
        return [(start, self.run.newest_ns if end < 0 else end) for start, end in spans]

    # --- the truth ---

    @cached_property
    def truth(self) -> list[Plain]:
        with (self.folder / "truth.jsonl").open(encoding="utf-8") as file:
            return [json.loads(line) for line in file]

    def events(self, *kinds: str) -> list[Plain]:
        return [one for one in self.truth if one["event"] in kinds]

    @cached_property
    def world(self) -> World:
        """The simulated world at the start of the trial."""
        first = self.events("start")[0]
        return World.from_settings(first["settings"], int(first["seed"]), float(first["time_s"]))

    def drift_m(self, time_s: float) -> NDArray[np.float64]:
        return np.asarray(self.world.drift_m(time_s)[:2], np.float64)

    def on_sample(self, xy_m: tuple[float, float], time_s: float) -> NDArray[np.float64]:
        """Convert a tip position to sample coordinates, in m."""
        return np.asarray(xy_m, np.float64) - self.drift_m(time_s)

    def tip_flaws(self, row: ScanRow) -> list[str]:
        """Return the true flaws of the tip during a scan."""
        name = Path(row.filename.replace("\\", "/")).name
        for event in self.events("scan"):
            if event["file"] == name:
                return sorted({flaw for tip in event["scan"]["tips"] for flaw in tip["flaws"]})
        return []

    def true_heights(self, region: Region, pixels: int) -> NDArray[np.float64]:
        """Return the true heights of a region without drift, [y, x], in m."""
        return true_heights(self.world, region, pixels)

    def minutes(self, time_ns: int) -> float:
        return (time_ns - self.began_ns) / 60e9


def true_heights(world: World, region: Region, pixels: int) -> NDArray[np.float64]:
    """Return the true heights at the start, on a square grid over an unrotated region, [y, x], in m."""
    (left, low), (width, height) = region.top_left_m, region.size_m
    x, y = np.linspace(left, left + width, pixels), np.linspace(low, low + height, pixels)
    return world.sample.surface_m(x[None, :], y[:, None])


def read_report(file: Path) -> tuple[Report | None, str]:
    """Return the report in a file and ""; None and the reason if there is no valid report."""
    try:
        return Report.from_plain(json.loads(read_left(file, MOST_REPORT_BYTES))), ""
    except FileNotFoundError:
        return None, "no report"
    except (ValueError, RecursionError, AfspmError) as error:
        return None, f"the report can't be read: {error}"


def _levels(plain: object) -> int:
    levels, level = 0, [plain]
    while level:
        levels += 1
        level = [inner for one in level if isinstance(one, dict | list) for inner in _inner(one)]
    return levels


def _inner(one: dict[str, object] | list[object]) -> Iterable[object]:
    return one.values() if isinstance(one, dict) else one


def times_of(rows: list[ScanRow] | list[SpectrumRow]) -> Iterator[float]:
    """Yield the midpoint of each measurement, in experiment seconds."""
    for row in rows:
        yield ((row.began_ns or row.time_ns) + row.time_ns) * 0.5e-9
