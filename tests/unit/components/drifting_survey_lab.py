"""The tutorial's survey in memory: the simulated sample drifts, and the real tracker and estimator follow it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from client_lab import Lab

from afspm import wire
from afspm.components.survey import Survey
from afspm.experiment import load
from afspm.model import Frame, Region, Scan
from afspm.plugins.drift.estimators import PairFailure, unguarded
from afspm.plugins.drift.frame.estimation import Estimation
from afspm.plugins.drift.frame.messages import Registered
from afspm.plugins.drift.frame.scheduler import DriftWireCodec
from afspm.plugins.drift.frame.settings import RescanRule
from afspm.plugins.drift.registration import DriftScan, Estimator
from afspm.plugins.drift.track import tracker
from afspm.simulation import World

TUTORIAL = Path(__file__).parents[3] / "docs" / "tutorials" / "particle-survey.md"


class DriftingLab(Lab):
    """A microscope over a drifting sample, and a scheduler that maps each region to the tip and back.

    The first scan is taken in both directions, as the Rescanner does.

    Args:
        folder: for the experiment file of the tutorial.
        estimator: registers scans; by default the built-in one, whose errors are raised.

    Attributes:
        registrations: forecasts published for each scan.
        off_m: distance of each published scan from its true place.
    """

    def __init__(
        self, folder: Path, seed: int, estimator: Estimator | None = None, failures: list[PairFailure] | None = None
    ) -> None:
        super().__init__("survey")
        (text,) = re.findall(r"```toml\n(# survey\.toml\n.*?)```", TUTORIAL.read_text(encoding="utf-8"), re.DOTALL)
        file = folder / "survey.toml"
        file.write_text(text, encoding="utf-8")
        processes = load(file).resolved.processes
        self.survey_settings: dict[str, Any] = dict(processes["survey"].settings)
        simulator = processes["microscope"].settings
        self.world = World.from_settings({name: simulator[name] for name in ("surface", "drift")}, seed, 0.0)
        self.channels = ("Height",)
        self.values["scan-speed"] = "10"
        self.registrations: list[Registered] = []
        self.off_m: list[float] = []
        self._end_s = 0.0
        self._first_off_m = np.zeros(2)
        following = tracker("bank", unguarded() if estimator is None else estimator)
        self._tracker = following
        self._estimation = Estimation(
            following, RescanRule("never"), lambda state: None, [] if failures is None else failures
        )

    def survey(self, **settings: Any) -> Survey:
        """Return the tutorial's survey, with these settings replaced."""
        return Survey(**{**self.survey_settings, **settings})

    def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        if not self.registrations:
            self._register(region, shape, upwards=False)
        scan, said = self._register(region, shape, upwards=True)
        file = f"scan-{len(self.registrations)}.nc"
        payload = DriftWireCodec().encode_mapping(said, file, scan.region.center_m, correcting=True, channel="Height")
        self.publish(wire.decode("DriftMapping", payload))
        there = said.mapping.to_sample(scan.region)
        self.publish(Scan(there, "Height", "m", scan.values, self.clock.now_ns(), file))

    def _register(self, region: Region, shape: tuple[int, int], *, upwards: bool) -> tuple[DriftScan, Registered]:
        line_s = 2.0 * region.size_m[0] / (10e-6 if region.size_m[0] > 1e-6 else 2e-6)
        start_s = (self._end_s + 60.0 if self.registrations else 10.0) + line_s  # two curves are taken after each
        middle_s = start_s + shape[0] * line_s / 2
        wanted = Region(region.center_m, region.size_m, region.angle_rad, Frame.SAMPLE)
        tip = self._tracker.forecast.at(middle_s).mapping.to_tip(wanted)
        taken = self.world.scan(tip, shape, line_s, start_s, direction="up" if upwards else "down")
        _, values = taken.channels()["Height"]
        scan = DriftScan(values, tip, taken.start_s, taken.end_s, upwards, f"{start_s:g}")
        said = self._estimation.register(scan.key, scan)
        self.registrations.append(said)
        truth_m = np.array(tip.center_m) - self.world.drift_m(scan.mid_s)[:2]
        off_m = np.array(said.mapping.to_sample(tip).center_m) - truth_m
        self._first_off_m = off_m if len(self.registrations) == 1 else self._first_off_m
        self.off_m.append(float(np.hypot(*(off_m - self._first_off_m))))
        self._end_s = taken.end_s
        return scan, said
