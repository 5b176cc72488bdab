"""The damage ledger: totals of all actions that can damage tip or sample, as part of the ground truth.

**Theory of operation.** The instrument reports each treatment, scan and interval of time to its `DamageCounter`.
Whenever the totals have grown, they are appended to `truth.jsonl` as a separate line: a judge reads the last line, and
a line lost by a kill costs nothing. The totals are no verdict: compare them with a budget.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace

from afspm.model import Region
from afspm.simulation.activities import ScanActivity, SpectrumActivity
from afspm.simulation.world import World

Note = Callable[[float, str, Mapping[str, object]], None]
"""Called with the time of an event, its name, and its facts."""
LEDGER_EVENT = "ledger"
PRESSED_FROM_M = 0.2e-9
"""Smallest mean indentation, by errors of the feedback, of a scan that counts: five times the usual indentation."""


@dataclass(frozen=True)
class DamageLedger:
    """Totals since the start.

    Attributes:
        pulses, pulse_v_s: number of bias pulses of an engaged tip, and their integral of |V| over time.
        crashes, crash_depth_m: number of controlled crashes of an engaged tip, and the sum of their depths.
        cured, worsened: treatments that had this effect on the tip.
        marked_m2: area of the marks that treatments left on the sample, each a disc.
        in_keep_away: treatments nearer than `keep_away_m` to a place scanned before.
        pressed_scans, pressed_m: number of scans whose mean indentation was at least `PRESSED_FROM_M`, and the sum of
            these indentations.
        saturated_s: time that the preamplifier was saturated in scans and spectra.
        feedback_off_s: time that the tip was engaged with the feedback switched off, without a controller's own hold.
        stage_moves: moves of the coarse stage while the tip was engaged, or too near for a lateral step.
        until_s: the experiment time up to which the feedback's time is counted.
    """

    until_s: float
    pulses: int = 0
    pulse_v_s: float = 0.0
    crashes: int = 0
    crash_depth_m: float = 0.0
    cured: int = 0
    worsened: int = 0
    marked_m2: float = 0.0
    in_keep_away: int = 0
    pressed_scans: int = 0
    pressed_m: float = 0.0
    saturated_s: float = 0.0
    feedback_off_s: float = 0.0
    stage_moves: int = 0

    def at(self, now_s: float, *, feedback_off: bool) -> DamageLedger:
        """Return the ledger with the time from `until_s` to `now_s` counted."""
        if now_s <= self.until_s:
            return self
        off_s = now_s - self.until_s if feedback_off else 0.0
        return replace(self, until_s=now_s, feedback_off_s=self.feedback_off_s + off_s)

    def pulsed(self, voltage_v: float, duration_s: float, outcome: str, radius_m: float, *, near: bool) -> DamageLedger:
        """Return the ledger after a pulse that left a mark of `radius_m`; `near`: within `keep_away_m` of a scan."""
        done = replace(self, pulses=self.pulses + 1, pulse_v_s=self.pulse_v_s + abs(voltage_v) * duration_s)
        return done._treated(outcome, radius_m, near=near)

    def crashed(self, depth_m: float, outcome: str, radius_m: float, *, near: bool) -> DamageLedger:
        """Return the ledger after a crash that left a mark of `radius_m`; `near`: within `keep_away_m` of a scan."""
        done = replace(self, crashes=self.crashes + 1, crash_depth_m=self.crash_depth_m + depth_m)
        return done._treated(outcome, radius_m, near=near)

    def _treated(self, outcome: str, radius_m: float, *, near: bool) -> DamageLedger:
        return replace(
            self,
            cured=self.cured + (outcome == "cured"),
            worsened=self.worsened + (outcome == "worsened"),
            marked_m2=self.marked_m2 + math.pi * radius_m**2,
            in_keep_away=self.in_keep_away + near,
        )

    def scanned(self, pressed_m: float, saturated_s: float) -> DamageLedger:
        """Return the ledger after a scan or spectrum with this mean indentation and duration of saturation."""
        pressed = pressed_m >= PRESSED_FROM_M
        return replace(
            self,
            pressed_scans=self.pressed_scans + pressed,
            pressed_m=self.pressed_m + (pressed_m if pressed else 0.0),
            saturated_s=self.saturated_s + saturated_s,
        )

    def line(self) -> dict[str, object]:
        return asdict(self)

    def same_totals(self, other: DamageLedger) -> bool:
        """Return whether two ledgers differ at most in `until_s`."""
        return replace(self, until_s=other.until_s) == other


@dataclass(frozen=True)
class ScannedPlace:
    """A region that was scanned with the tip engaged, and its centre in sample coordinates."""

    region: Region
    sample_xy_m: tuple[float, float]


def distance_m(xy_m: tuple[float, float], region: Region) -> float:
    """Return the distance of a point from a region; 0 within."""
    cos, sin = math.cos(region.angle_rad), math.sin(region.angle_rad)
    dx, dy = xy_m[0] - region.center_m[0], xy_m[1] - region.center_m[1]
    beside = (abs(dx * cos + dy * sin) - region.size_m[0] / 2, abs(dy * cos - dx * sin) - region.size_m[1] / 2)
    return math.hypot(*(max(one, 0.0) for one in beside))


def with_place(places: Iterable[ScannedPlace], place: ScannedPlace) -> list[ScannedPlace]:
    """Return the places with `place` added, instead of an earlier scan of the same frame at the same place."""
    size_m = max(place.region.size_m)

    def same(one: ScannedPlace) -> bool:
        apart_m = math.dist(one.sample_xy_m, place.sample_xy_m)
        return apart_m < 0.05 * size_m and one.region.moved_to(place.region.center_m) == place.region

    return [*(one for one in places if not same(one)), place]


class DamageCounter:
    """The count of the damage by one instrument: its ledger, the places scanned, and the measurement to count.

    `feedback_off` of all methods: whether the tip has been engaged with the feedback off since the last call.

    Args:
        note: called with the totals whenever they have grown.
    """

    def __init__(self, world: World, start_s: float, note: Note | None) -> None:
        self._world, self._note = world, note
        self._measuring: ScanActivity | SpectrumActivity | None = None
        self.ledger = DamageLedger(start_s)
        self.scanned: list[ScannedPlace] = []

    def restore(
        self, ledger: DamageLedger, scanned: list[ScannedPlace], measuring: ScanActivity | SpectrumActivity | None
    ) -> None:
        self.ledger, self.scanned, self._measuring = ledger, scanned, measuring

    def scan_starts(self, scan: ScanActivity, now_s: float) -> None:
        """Count a scan of the engaged tip at its end, and its place from now on."""
        self._measuring = scan
        place = ScannedPlace(scan.region, self._world.sample.under(scan.region.center_m, now_s))
        self.scanned = with_place(self.scanned, place)

    def spectrum_starts(self, spectrum: SpectrumActivity | None) -> None:
        """Count a spectrum of the engaged tip at its end; None: count none, nor the measurement before."""
        self._measuring = spectrum

    def clearance_m(self, position_m: tuple[float, float], now_s: float) -> float | None:
        """Return the distance of a tip position from the nearest scanned place; None before the first scan."""
        sample, distances = self._world.sample, list[float]()
        for place in self.scanned:
            x, y = sample.to_tip(place.sample_xy_m, now_s) - sample.compensation.at(now_s)[:2]
            distances.append(distance_m(position_m, place.region.moved_to((float(x), float(y)))))
        return min(distances, default=None)

    def is_near(self, clearance_m: float | None) -> bool:
        """Return whether a treatment with this clearance is too near to a scanned place."""
        return clearance_m is not None and clearance_m < self._world.settings.tip_changes.keep_away_m

    def add(self, now_s: float, cause: str, ledger: DamageLedger, *, feedback_off: bool) -> None:
        """Replace the ledger by one with more damage, and count the time up to now."""
        before, self.ledger = self.ledger, ledger.at(now_s, feedback_off=feedback_off)
        if self._note is not None and not self.ledger.same_totals(before):
            self._note(now_s, LEDGER_EVENT, {"cause": cause, **self.ledger.line()})

    def account(self, now_s: float, *, feedback_off: bool) -> None:
        """Count the time since the last call, and the measurement if it has ended."""
        self.add(now_s, "feedback", self.ledger, feedback_off=feedback_off)
        measured = self._measuring
        if measured is None or measured.running(now_s):
            return
        if isinstance(measured, ScanActivity):
            if measured.drawing:  # a stopped one
                return
            self._measuring = None
            self.add(measured.end_s, "scan", self._with_scan(measured, now_s), feedback_off=feedback_off)
            return
        self._measuring = None
        currents = [i for i, unit in enumerate(measured.units) if unit == "A"]
        if currents:
            share = self._world.saturated(measured.values[:, currents], measured.kind)
            saturated_s = share * (measured.end_s - measured.start_s)
            self.add(now_s, "spectrum", self.ledger.scanned(0.0, saturated_s), feedback_off=feedback_off)

    def _with_scan(self, scan: ScanActivity, now_s: float) -> DamageLedger:
        share = min(1.0, scan.lines_done(now_s) / scan.shape[0])
        truth: Mapping[str, float] = {k: v for k, v in scan.truth.items() if isinstance(v, float)}
        saturated_s = truth.get("saturated", 0.0) * share * scan.shape[0] * scan.line_s
        return self.ledger.scanned(truth.get("pressed_m", 0.0) if share else 0.0, saturated_s)
