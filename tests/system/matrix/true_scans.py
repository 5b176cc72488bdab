"""The truth about the scans and curves of a cell: from the simulator's record, or from the sample that Nion simulates.

A true picture is made of the sample at the place where the microscope really scanned, without noise and with a feedback
that loses nothing. Nothing here reads a result of the run.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from afspm.model import Feedback, Region
from afspm.model.arrays import Array
from afspm.simulation import World
from afspm.simulation.feedback import Loop

IDEAL_LOOP = {"mode": "amplitude", "lag_s": 1e-6, "delay_s": 1e-6, "integral_gain": 2e5}
QUIET = dict.fromkeys(
    ("white_m", "one_over_f_m", "line_offset_m", "scar_probability", "debris_jumps_per_s", "amplitude_v", "current_a"),
    0.0,
)


@dataclass(frozen=True)
class TrueScan:
    """One scan that the microscope made.

    Attributes:
        region: the frame under the tip.
        mid_s: middle of the scan.
        flaws: flaws of the tip at its start; changed_s: first change of the tip during the scan.
        stopped_s: the time of its interruption.
    """

    start_s: float
    mid_s: float
    end_s: float
    region: Region
    line_s: float = math.nan
    feedback: Mapping[str, Any] | None = None
    flaws: tuple[str, ...] = ()
    changed_s: float | None = None
    stopped_s: float | None = None
    entry: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class TrueCurve:
    """One curve that the microscope took."""

    kind: str
    position_m: tuple[float, float]
    time_s: float
    bias_v: float


class Truth(Protocol):
    """The truth about one run."""

    @property
    def scans(self) -> Sequence[TrueScan]: ...
    @property
    def curves(self) -> Sequence[TrueCurve]: ...

    def picture(self, number: int, shape: tuple[int, int]) -> Array:
        """Return the true picture of a scan, by its index, [y, x], y ascending."""
        ...

    def drift_m(self, number: int) -> Array:
        """Return the true displacement (x, y) of the sample in the middle of a scan, by its index."""
        ...


class SimulatedTruth:
    """The truth of the simulated microscope, or of an emulated controller."""

    def __init__(self, file: Path) -> None:
        entries = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        self.entries: list[dict[str, Any]] = entries
        (self._start,) = [one for one in entries if one["event"] == "start"]
        self.scans = [self._scan(n) for n, one in enumerate(entries) if one["event"] == "scan starts"]
        self.curves = [
            TrueCurve(one["kind"], tuple(one["position_m"]), one["time_s"], one["bias_v"])
            for one in entries
            if one["event"] == "spectrum starts"
        ]

    def _scan(self, number: int) -> TrueScan:
        entry, rest = self.entries[number], self.entries[number + 1 :]
        setup = entry["setup"]
        region = Region(tuple(setup["center_m"]), tuple(setup["size_m"]), setup["angle_rad"])
        start_s = entry["time_s"]
        end_s = start_s + setup["shape"][0] * setup["line_s"]
        nexts = [n for n, one in enumerate(rest) if one["event"] == "scan starts"]
        meanwhile = rest[: nexts[0]] if nexts else rest
        stopped = [one["time_s"] for one in meanwhile if one["event"] == "scan stopped"]
        earlier = [one for one in self.tip_changes if one["t_s"] <= start_s]
        flaws = {*(earlier[-1]["tip"]["flaws"] if earlier else ())}
        flaws |= {condition for t_s, condition in entry["changes_in_scan"] if t_s <= start_s}
        during = [t_s for t_s, _ in entry["changes_in_scan"] if start_s < t_s < min([end_s, *stopped])]
        return TrueScan(
            start_s,
            (start_s + end_s) / 2.0,
            end_s,
            region,
            setup["line_s"],
            setup["feedback"],
            tuple(sorted(flaws)),
            during[0] if during else None,
            stopped[0] if stopped else None,
            entry,
        )

    @cached_property
    def tip_changes(self) -> list[dict[str, Any]]:
        """All changes of the tip that were not revoked, in the order of time."""
        for entry in reversed(self.entries):
            if "truth" in entry:
                changes: list[dict[str, Any]] = entry["truth"]["tip_changes"]
                return changes
        return []

    def world(self, **instead: object) -> World:
        """Return the world at the start, with some settings replaced."""
        settings = {**self._start["settings"], "noise": QUIET, **instead}
        return World.from_settings(settings, int(self._start["seed"]), float(self._start["time_s"]))

    def picture(self, number: int, shape: tuple[int, int]) -> Array:
        return self._drawn(number, Feedback(), IDEAL_LOOP)

    def followed(self, number: int) -> Array:
        """Return the picture that the feedback of a scan makes of the sample, without noise."""
        entry = self.scans[number].entry
        assert entry is not None
        return self._drawn(number, Feedback(**entry["setup"]["feedback"]), self._start["settings"].get("feedback", {}))

    def oscillates(self, number: int) -> bool:
        """Return whether the loop of a scan is beyond its limit of stability."""
        feedback = self.scans[number].feedback
        assert feedback is not None
        return Loop.of(self.world().settings.feedback, Feedback(**feedback)).oscillates

    def _drawn(self, number: int, feedback: Feedback, loop: Mapping[str, object]) -> Array:
        scan = self.scans[number]
        assert scan.entry is not None
        setup = scan.entry["setup"]
        world = self.world(feedback=loop)
        way = "up" if setup["upwards"] else "down"
        shape = (int(setup["shape"][0]), int(setup["shape"][1]))
        drawn = world.scan(scan.region, shape, setup["line_s"], scan.start_s, feedback, setup["bias_v"], direction=way)
        return drawn.channels()["Height"][1]

    def drift_m(self, number: int) -> Array:
        return self.world().sample.drift.at(self.scans[number].mid_s)[:2]

    def height_m(self, positions_m: Array, time_s: float) -> Array:
        """Return the true height of the sample at places (n, 2) under the tip."""
        world = self.world()
        places = [world.sample.under((float(x), float(y)), time_s) for x, y in positions_m]
        relief = [world.sample.relief(np.array([[x]]), np.array([[y]]), 0.0, time_s) for x, y in places]
        return np.array([one.height_m[0, 0] for one in relief])

    def material(self, position_m: tuple[float, float], time_s: float) -> float:
        """Return the material, 0 to 1, under the tip."""
        world = self.world()
        x, y = world.sample.under(position_m, time_s)
        return float(world.sample.relief(np.array([[x]]), np.array([[y]]), 0.0, time_s).material[0, 0])


class NionTruth:
    """The truth of Nion's simulated microscope: its flakes, and the stage that the driver moves."""

    curves: Sequence[TrueCurve] = ()

    def __init__(self, stage: Path) -> None:
        with stage.open(newline="", encoding="utf-8") as file:
            rows = [[float(value) for value in row] for row in csv.reader(file)]
        self._stage_m = np.array(rows)[:, 1:3]
        self.scans = [
            TrueScan(start_s, mid_s, 2.0 * mid_s - start_s, Region((x, y), (width, height)))
            for mid_s, _, _, start_s, x, y, width, height in rows
        ]

    def picture(self, number: int, shape: tuple[int, int]) -> Array:
        from nion.usim_device.InstrumentDevice import ScanDataGenerator

        region = self.scans[number].region
        # Nion's y points downwards
        place_m = (np.array(region.center_m) - self._stage_m[number])[::-1] * (-1.0, 1.0)
        pitch_m = region.size_m[0] / (shape[1] - 1)
        # each flake lies on whole pixels of a frame with a margin of half a turn
        margin = math.ceil(max(shape) * (math.sqrt(2.0) - 1.0))
        origin_m = place_m - (np.array(shape) + margin) * pitch_m / 2.0
        picture = np.zeros(np.array(shape) + margin)
        for flake in ScanDataGenerator().sample.features:
            size_m = np.array(tuple(flake.size_m))
            begin = ((tuple(flake.position_m) - size_m / 2.0 - origin_m) / pitch_m).astype(int)
            end = begin + (size_m / pitch_m).astype(int)
            (top, left), (bottom, right) = begin.clip(0), end.clip(0)
            picture[top:bottom, left:right] += 1.0
        half = margin // 2
        return np.flipud(picture[half : half + shape[0], half : half + shape[1]])

    def drift_m(self, number: int) -> Array:
        return np.asarray(self._stage_m[number])


def truth_of(folder: Path) -> Truth:
    """Return the truth about the run in a folder."""
    if (stage := folder / "stage.csv").exists():
        return NionTruth(stage)
    (file,) = (*folder.glob("truth.jsonl"), *folder.glob("*/truth.jsonl"))
    return SimulatedTruth(file)
