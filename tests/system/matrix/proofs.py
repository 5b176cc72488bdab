"""What proves that a component has done its work: a number of the run beside the same number by the truth.

A proof returns nothing if both agree, else what is wrong, as the table shows it.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import re
import statistics
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from tests.system.matrix.true_scans import SimulatedTruth, TrueScan, Truth, truth_of

import afspm
from afspm.basics.units import convert, si_unit
from afspm.components import Levelling, levelled
from afspm.model import Problem, ScanSet, names
from afspm.model.arrays import Array
from afspm.night.run import Run
from afspm.night.tables import ScanRow
from afspm.wire.messages import TipVerdict

DONE = "done"
NO_GAIN = "no gain is good here"
"""The outcome of a search for a gain where none exists; neither a success nor a fault."""
NOTHING = "measures nothing"
PICTURE = 0.3  # of the relief: the feedback misses 0.1 at the usual gain, and a shift by a pixel 0.5
FOLLOWS = 0.2  # of the relief, by which the analysis calls a feedback good
NION_NOISE = 0.3  # that Nion adds to each pixel, in flakes
QUANTITY = 0.05
POTENTIAL_V = 0.005
TWO_POINTS = 0.07  # of the adhesion of a soft cantilever: a pull-off is between two points, as is a resampled one
PLACE_PX = 1.5  # a busy computer begins a scan later than its place was predicted for; without correction 6
MIDDLE_S = 5.0
LATE_S = 15.0  # of experiment time, a quarter of a second in real time
_BLOCKS = 16  # along each side of the numbers that an agent gets of a scan
DRIFT_M = 2e-9  # an eighth of a pixel
NION_DRIFT_M = 8e-9  # half a pixel, since Nion's features lie on whole ones
_NS = 1e9
_RECORDED_S = 120.0  # the end of a run may meet a scan that is not read yet


class NotFinished(AssertionError):
    """The error of a run that a busy computer has not let finish its job: it proves nothing."""


@dataclass(frozen=True)
class Evidence:
    """A run that has ended: its record, and the truth."""

    folder: Path
    record: Run
    truth: Truth

    @cached_property
    def rows(self) -> dict[int, ScanRow]:
        """Each complete scan of the record, by the index of the newest scan that had begun at its end."""
        begins_s = [one.start_s for one in self.truth.scans]
        whole = (row for row in self.record.scans if not row.interrupted)
        return {bisect_right(begins_s, row.time_ns / _NS) - 1: row for row in whole}

    @property
    def pairs(self) -> list[tuple[int, ScanRow, TrueScan]]:
        return [(number, row, self.truth.scans[number]) for number, row in self.rows.items()]

    @property
    def lost(self) -> int:
        """Number of scans that the microscope ended, and the record lacks, or has twice."""
        newest_s = self.record.newest_ns / _NS
        ended = [
            n for n, one in enumerate(self.truth.scans) if one.stopped_s is None and one.end_s < newest_s - _RECORDED_S
        ]
        whole = sum(not row.interrupted for row in self.record.scans)
        return len({*ended} - {*self.rows}) + whole - len(self.rows)

    @property
    def disturbance(self) -> str:
        """What a busy computer has done to the run; empty if nothing."""
        interrupted = sum(row.interrupted for row in self.record.scans)
        interrupted -= sum(one.stopped_s is not None for one in self.truth.scans)
        if interrupted > 0:
            return f"{interrupted} scans were interrupted for another reason than the job"
        late_s = max((row.time_ns / _NS - true.end_s for _, row, true in self.pairs), default=0.0)
        return f"the end of a scan was seen {late_s:.0f} s late" if late_s > LATE_S else ""

    def scan(self, row: ScanRow) -> ScanSet:
        return self.record.scan(row)

    @property
    def simulated(self) -> SimulatedTruth:
        assert isinstance(self.truth, SimulatedTruth)
        return self.truth

    def missed(self, values: Array, number: int) -> float:
        """Return the part of the relief that a picture misses; heights in m, else in any unit."""
        true = self.truth.picture(number, values.shape)
        values, true = values - values.mean(), true - true.mean()
        if (
            self.noise
        ):  # counts in the microseconds of a pixel; noise hides a part of the relief, and adds nothing to it
            scan = self.truth.scans[number]
            values = values / ((scan.end_s - scan.start_s) / values.size * 1e6)
            return abs(1.0 - float((values * true).mean()) / float(true.var()))
        return float((values - true).std() / true.std())

    @property
    def noise(self) -> float:
        """The noise that the microscope adds to each pixel of a true picture, in the unit of the truth."""
        return 0.0 if isinstance(self.truth, SimulatedTruth) else NION_NOISE


Proof = Callable[[Evidence], str]


def correlation(one: Array, other: Array) -> float:
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


def all_of(*proofs: Proof) -> Proof:
    """Return a proof that fails with the first of several."""
    return lambda found: next((wrong for proof in proofs if (wrong := proof(found))), "")


def taken(at_least: int) -> Proof:
    """Return a proof: the record has the scans that the microscope made, and each shows the sample at its place."""

    def proof(found: Evidence) -> str:
        if found.lost:
            return f"{found.lost} of {len(found.truth.scans)} scans are not in the record once"
        if len(found.pairs) < at_least:
            return f"{len(found.pairs)} of {at_least} scans"
        for number, row, true in found.pairs:
            if true.flaws or true.changed_s:
                continue  # its picture is another one by intention
            scan = found.scan(row)["topography"]
            if (missed := found.missed(scan.values, number)) > PICTURE:
                return f"scan {row.number} misses {missed:.0%} of the relief"
        return ""

    return proof


def frames(*wanted: tuple[tuple[float, float], tuple[float, float]]) -> Proof:
    """Return a proof: the microscope scanned these frames, in nm (centre, size)."""

    def proof(found: Evidence) -> str:
        regions = [true.region for _, _, true in found.pairs]
        for (center_nm, size_nm), region in zip(wanted, regions, strict=False):
            off_nm = [
                abs(a * 1e9 - b)
                for a, b in zip((*region.center_m, *region.size_m), (*center_nm, *size_nm), strict=True)
            ]
            if max(off_nm) > 1.0:
                return f"a scan is {max(off_nm):.0f} nm beside its place"
        return "" if len(regions) >= len(wanted) else f"{len(regions)} of {len(wanted)} scans"

    return proof


def controlled(found: Evidence) -> str:
    """Prove that each scan was made for the component in control."""
    return "" if all(row.holder for row in found.rows.values()) else "a scan without a component in control"


def _is_drawn(found: Evidence, name: str) -> bool:
    if not (found.folder / name).exists():
        raise NotFinished(f"{name} was not drawn before its component was stopped")
    return (found.folder / name).read_bytes().startswith(b"\x89PNG")


def drawn(found: Evidence) -> str:
    """Prove that the picture of the night has each scan, as it was."""
    (file,) = (found.folder / "state").glob("*.night.jsonl")
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    shots = [one for one in lines if one["kind"] == "scan"]
    if not _is_drawn(found, "night.png") or len(shots) != len(found.truth.scans):
        return f"{len(shots)} of {len(found.truth.scans)} scans are drawn"
    for number, shot in enumerate(shots):
        levels = np.frombuffer(base64.b64decode(shot["picture"]), np.uint8).reshape(shot["shape"]).astype(float)
        if wrong := _unlike(found, levels, number):
            return wrong
    return ""


def _unlike(found: Evidence, levels: Array, number: int) -> str:
    # a picture in levels of one colour map, levelled, at either end of the slow axis
    true = found.truth.picture(number, levels.shape)
    alike = correlation(levels, np.clip(true, *np.percentile(true, (1.0, 99.0))))
    alike *= math.hypot(float(true.std()), found.noise) / float(true.std())
    return "" if alike > 0.9 else f"a picture that has {alike:.2f} in common with the sample"


def tabled(found: Evidence) -> str:
    """Prove that the table of measurements has each scan at its true place."""
    with (found.folder / "metadata.csv").open(newline="", encoding="utf-8") as file:
        rows = [one for one in csv.DictReader(file) if one["measurement"] == "scan"]
    channels = {one["channel"] for one in rows}
    if len(rows) != len(channels) * len(found.truth.scans):
        return f"{len(rows)} rows of {len(channels)} channels, {len(found.truth.scans)} scans"
    for number, true in enumerate(found.truth.scans):
        region = true.region
        of_scan = rows[number * len(channels)]
        stated = [float(of_scan[name]) for name in ("center_x", "center_y", "width", "height")]
        if max(abs(a - b) for a, b in zip(stated, (*region.center_m, *region.size_m), strict=True)) > 1e-9:
            return f"scan {number + 1} is tabled at another place"
    return ""


def logged(found: Evidence) -> str:
    """Prove that the collected log has a line of each scan."""
    text = "".join(one.read_text(encoding="utf-8") for one in found.folder.glob("log-all*.txt"))
    lines = len(set(re.findall(r"scan \d+ of 4 at ", text)))
    return "" if lines == len(found.truth.scans) else f"{lines} of {len(found.truth.scans)} scans in the log"


def _seen(found: Evidence) -> list[dict[str, str]]:
    seen: list[dict[str, str]] = json.loads((found.folder / "seen.json").read_text(encoding="utf-8"))
    return seen


def asked(found: Evidence) -> str:
    """Prove that the gateway returned the values of each scan."""
    seen = _seen(found)
    for number, one in enumerate(seen):
        values = np.load(io.BytesIO(base64.b64decode(one["values"])))
        if (missed := found.missed(values, number)) > PICTURE:
            return f"the values of scan {number + 1} miss {missed:.0%} of the relief"
    return "" if len(seen) == len(found.truth.scans) else f"{len(seen)} of {len(found.truth.scans)} scans"


def shown(found: Evidence) -> str:
    """Prove that the page showed the picture of each scan."""
    image = pytest.importorskip("matplotlib.image")
    seen = _seen(found)
    for number, one in enumerate(seen):
        colours = image.imread(io.BytesIO(base64.b64decode(one["picture"])))[::-1, :, :3]
        if wrong := _unlike(found, colours.sum(axis=2), number):
            return f"scan {number + 1}: {wrong}"
    return "" if len(seen) == len(found.truth.scans) else f"{len(seen)} of {len(found.truth.scans)} scans"


def judged(found: Evidence) -> str:
    """Prove that each verdict on the tip is its true state, and that both verdicts were given."""
    verdicts = [(row.tip_score, true.flaws) for _, row, true in found.pairs if row.tip_score is not None]
    wrong = [(score, flaws) for score, flaws in verdicts if score != (0.0 if flaws else 1.0)]
    if wrong:
        return f"{len(wrong)} of {len(verdicts)} verdicts"
    return "" if {score for score, _ in verdicts} == {0.0, 1.0} else f"{len(verdicts)} verdicts"


def watched(found: Evidence) -> str:
    """Prove that the lines raise an alarm in the scan in which the tip changed, at the true line, and in no other."""
    alarms = [(time_ns / _NS, one) for time_ns, one in found.record.judgements() if isinstance(one, TipVerdict)]
    (true,) = (one for one in found.truth.scans if one.changed_s is not None)
    assert true.changed_s is not None
    if not alarms:
        watched_scans = sum(one.watched for one in found.record.watch_counts().values())
        return "no alarm in the scan in which the tip changed" if watched_scans else NOTHING
    for time_s, _ in alarms:
        if not true.changed_s < time_s or any(true.end_s < one.start_s < time_s for one in found.truth.scans):
            return "an alarm in a scan with a good tip"
    *_, (_, alarm) = alarms
    assert true.entry is not None
    rows = int(true.entry["setup"]["shape"][0])
    line = rows - 1 - alarm.since_row if alarm.downwards else alarm.since_row
    off = line - (true.changed_s - true.start_s) / true.line_s
    return "" if abs(off) <= rows / 8 else f"the tip is said to have changed {off:+.0f} lines beside the truth"


def repaired(found: Evidence) -> str:
    """Prove that the tip was flawed, was treated away from all scans, and is sharp at the end."""
    if not any(true.flaws for true in found.truth.scans):
        return "the tip never changed"
    *_, last = found.simulated.tip_changes
    if last["tip"]["flaws"]:
        return f"the tip is {', '.join(last['tip']['flaws'])} at the end"
    near = [one for one in found.simulated.entries if one["event"] == "ledger"][-1]["in_keep_away"]
    return f"{near} treatments near a scan" if near else ""


def _missed_by_loop(found: Evidence, number: int) -> float:
    # the part of the relief that the feedback of this scan loses by the truth; infinite if it oscillates
    truth = found.simulated
    if truth.oscillates(number):
        return math.inf
    followed, picture = truth.followed(number), truth.picture(number, (0, 0))
    followed, picture = followed - followed.mean(), picture - picture.mean()
    return float((followed - picture).std() / picture.std())


def flagged(found: Evidence) -> str:
    """Prove that the feedback was flagged after the first scan with a bad one, and not before."""
    flags = [one for one in found.record.problems if one.number == Problem.FEEDBACK_NON_OPTIMAL]
    if not flags:
        return "no flag"
    for number, true in enumerate(found.truth.scans):
        is_good = _missed_by_loop(found, number) <= FOLLOWS
        is_flagged = flags[0].flagged_ns / _NS < true.end_s
        if is_good and is_flagged:
            return "a good feedback was flagged"
        if not is_good:
            after = [one.end_s for one in found.truth.scans if one.start_s > true.end_s]
            late = bool(after) and flags[0].flagged_ns / _NS > after[0]
            return "a bad feedback was not flagged" if late else ""
    return "the feedback was never bad"


def tuned(found: Evidence) -> str:
    """Prove that the loop in force at the end follows the sample; NO_GAIN if none of the gains that were tried does."""
    tried = [number for number, row, _ in found.pairs if row.holder == "tuner"]
    if not tried:
        return "no gain was tried"
    if (missed := _missed_by_loop(found, found.pairs[-1][0])) <= FOLLOWS:
        return ""
    if min(_missed_by_loop(found, number) for number in tried) > FOLLOWS:
        return NO_GAIN
    return f"the gain at the end misses {missed:.0%} of the relief, though a good one was tried"


def _drifted_m(found: Evidence, number: int) -> Array:
    return np.asarray(found.truth.drift_m(number) - found.truth.drift_m(0))


def _drift_rows(found: Evidence) -> list[dict[str, str]]:
    with (found.folder / "drift_table.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _at_middle(found: Evidence, time_s: float) -> int:
    return min(range(len(found.truth.scans)), key=lambda number: abs(found.truth.scans[number].mid_s - time_s))


def drift_tabled(found: Evidence) -> str:
    """Prove that the table has the true drift of each scan."""
    rows = [one for one in _drift_rows(found) if one["outcome"] == "registered"]
    drift_m = np.array([[float(one["drift_x_m"]), float(one["drift_y_m"])] for one in rows])
    if len(rows) < 4:
        return f"{len(rows)} scans are registered"
    numbers = [_at_middle(found, float(one["time_s"])) for one in rows]
    true_m = np.array([_drifted_m(found, number) - _drifted_m(found, numbers[0]) for number in numbers])
    off_m = float(np.hypot(*(drift_m - drift_m[0] - true_m).T).max())
    far_m = float(np.hypot(*true_m.T).max())
    if far_m < 5 * DRIFT_M:
        return f"the sample drifted by {far_m * 1e9:.0f} nm alone"
    allowed_m = NION_DRIFT_M if found.noise else DRIFT_M
    return "" if off_m <= allowed_m else f"the drift is {off_m * 1e9:.0f} nm beside the true one"


def _places_m(found: Evidence, holder: str) -> Array:
    # where the scans of a component from the fourth on lie on the sample, in m beside the first one
    places = [np.array(true.region.center_m) - found.truth.drift_m(n) for n, _, true in found.pairs]
    return np.array(
        [
            place - places[0]
            for place, (n, row, _) in zip(places, found.pairs, strict=True)
            if row.holder == holder and n >= 3
        ]
    )


def held(holder: str, size_m: float, pixels: int) -> Proof:
    """Return a proof: the scans of a component stay at their place on the drifting sample."""

    def proof(found: Evidence) -> str:
        places_m = _places_m(found, holder)
        if not len(places_m):
            return f"no scan of {holder}"
        off_px = float(np.hypot(*places_m.T).max()) / (size_m / (pixels - 1))
        return "" if off_px <= PLACE_PX else f"{off_px:.1f} pixels beside the place on the sample"

    return proof


def drift_drawn(found: Evidence) -> str:
    """Prove that the figures have each scan at its true time: another one draws an error that is not there."""
    if not _is_drawn(found, "drift_offset.png"):
        return "no figure"
    times_s = [float(one["time_s"]) for one in _drift_rows(found)]
    late_s = statistics.median(time_s - found.truth.scans[_at_middle(found, time_s)].mid_s for time_s in times_s)
    return "" if abs(late_s) <= MIDDLE_S else f"scans are drawn {late_s:+.0f} s beside their true time"


_QUIET_CURVES = {
    "iv": {"noise_a": 0.0, "relative_noise": 0.0, "noise_density_a": 0.0},
    "force": {"noise_m": 0.0},
}


def _true_columns(found: Evidence, number: int) -> list[tuple[str, Array]]:
    # the variables of a curve with their units, forward, backward and both
    curve = found.truth.curves[number]
    world = found.simulated.world(**_QUIET_CURVES)
    names, units, values = world.spectrum(curve.kind, curve.position_m, curve.time_s, bias_v=curve.bias_v)
    table = dict(zip(names, zip(units, values.T, strict=True), strict=True))
    both = [
        (unit, np.concatenate([one, table[f"{name} Retrace"][1]]))
        for name, (unit, one) in table.items()
        if f"{name} Retrace" in table
    ]
    return [*table.values(), *both]


def curves(at_least: int, *places_nm: tuple[float, float]) -> Proof:
    """Return a proof: the curves were taken where the record and the plan have them, and have the true values."""

    def proof(found: Evidence) -> str:
        rows, true = list(found.record.spectra), found.truth.curves
        if len(rows) != len(true) or len(rows) < at_least:
            return f"{len(true)} curves were taken, {len(rows)} recorded"
        wanted_m = [(x * 1e-9, y * 1e-9) for x, y in places_nm] or [row.position_m for row in rows if row.position_m]
        for number, (row, place_m) in enumerate(zip(rows, wanted_m, strict=True)):
            assert row.position_m is not None
            if max(math.dist(true[number].position_m, one) for one in (place_m, row.position_m)) > 1e-9:
                return "a curve was taken at another place"
            if wrong := _wrong_values(found, number):
                return wrong
        return ""

    return proof


def _wrong_values(found: Evidence, number: int) -> str:
    spectrum, true = found.record.spectrum(found.record.spectra[number]), _true_columns(found, number)
    shares = np.linspace(0.0, 100.0, 21)
    right = set()
    for column, given in enumerate(spectrum.units):
        unit = si_unit(given)
        quantiles = np.percentile(spectrum.values[:, column] * convert(1.0, given, unit), shares)
        of_unit = [np.percentile(values, shares) for one, values in true if one == unit]
        off = [float(abs(quantiles - one).max() / np.ptp(one)) for one in of_unit]
        if off and min(off) <= QUANTITY:
            right.add(unit)
        elif off and unit in ("A", "N"):
            return f"{spectrum.names[column]} is {min(off):.0%} of its range beside the true values"
    return "" if right & {"A", "N", "m"} else "no variable of a curve has its true values"


def _map(found: Evidence) -> list[list[float]]:
    file = found.folder / "map.csv"
    if not file.exists():
        return []
    with file.open(newline="", encoding="utf-8") as text:
        return [[float(value) for value in row] for row in list(csv.reader(text))[1:]]


def mapped_by(function: Callable[[afspm.Spectrum], float]) -> Proof:
    """Return a proof: each value of the map is the function of the true curve at its place."""

    def proof(found: Evidence) -> str:
        rows = _map(found)
        if len(rows) != len(found.truth.curves) or not rows:
            return f"{len(rows)} of {len(found.truth.curves)} values"
        for number, (x_m, y_m, value, *_) in enumerate(rows):
            of_curve = function(found.record.spectrum(found.record.spectra[number]))
            if math.dist((x_m, y_m), found.truth.curves[number].position_m) > 1e-9 or not math.isclose(
                value, of_curve, rel_tol=1e-4
            ):
                return "a value is not that of the curve at its place"
        return ""

    return proof


def mapped(
    quantity: str,
    true_value: Callable[[Evidence, tuple[float, float], float], float],
    within: float,
    at_least: int = 6,
    unit: str = "",
) -> Proof:
    """Return a proof: the map of a shipped quantity has the true values, within a share of them or within a unit."""

    def proof(found: Evidence) -> str:
        rows = _map(found)
        if not rows:
            if len(found.truth.curves) < at_least:
                raise NotFinished(f"{len(found.truth.curves)} of {at_least} curves were taken")
            return NOTHING
        pairs = [(value, true_value(found, (x_m, y_m), time_s)) for x_m, y_m, value, time_s, *_ in rows]
        off = statistics.median(value - true if unit else value / true - 1.0 for value, true in pairs)
        beside = f"{off:+.2g} {unit}" if unit else f"{off:+.1%}"
        return "" if abs(off) <= within else f"{beside} beside the true {quantity}"

    return proof


def true_adhesion_n(found: Evidence, position_m: tuple[float, float], time_s: float) -> float:
    """Return the pull-off force of Derjaguin, Muller and Toporov, 2 pi R w."""
    world = found.simulated.world()
    soft, hard = world.settings.force.adhesion_j_per_m2
    material = found.simulated.material(position_m, time_s)
    return 2.0 * math.pi * world.tip.imaging_radius_m * (soft * (1.0 - material) + hard * material)


def sampled_adhesion_n(found: Evidence, position_m: tuple[float, float], time_s: float) -> float:
    """Return the lowest force of the noiseless curve: its pull-off is between two of its points."""
    curve = min(found.truth.curves, key=lambda one: math.dist(one.position_m, position_m))
    names, _, values = found.simulated.world(**_QUIET_CURVES).spectrum(curve.kind, curve.position_m, curve.time_s)
    return -float(values[:, names.index("Force Retrace")].min())


def sampled_as_simulated(found: Evidence) -> bool:
    """Return whether the files have the simulated points, and not others between them, as Asylum's emulated files."""
    curve = found.truth.curves[0]
    _, _, values = found.simulated.world().spectrum(curve.kind, curve.position_m, curve.time_s)
    heights_m = found.record.spectrum(found.record.spectra[0]).of("height, retrace")
    return math.isclose(float(np.ptp(heights_m)), float(np.ptp(values[:, 0])), rel_tol=1e-3)


def adhesion_mapped(found: Evidence) -> str:
    """Prove the adhesion by the points of the noiseless curve, or by the law of the contact, up to two points below."""
    if found.truth.curves and len(found.record.spectra) and not sampled_as_simulated(found):
        return mapped("adhesion", true_adhesion_n, TWO_POINTS)(found)
    return mapped("adhesion", sampled_adhesion_n, 0.01)(found) or mapped("adhesion", true_adhesion_n, QUANTITY)(found)


def true_potential_v(found: Evidence, position_m: tuple[float, float], time_s: float) -> float:
    true = found.simulated.world().property_truth(position_m, time_s)["property"]
    assert isinstance(true, dict)
    return float(true["value"])


def true_gap_ev(found: Evidence, position_m: tuple[float, float], time_s: float) -> float:
    world = found.simulated.world()
    return world.settings.iv.gap_ev * (1.0 - 0.3 * found.simulated.material(position_m, time_s))


def surveyed(found: Evidence) -> str:
    """Prove that each target is the top of a particle."""
    with (found.folder / "targets.csv").open(newline="", encoding="utf-8") as file:
        targets = [(float(one["x"]), float(one["y"])) for one in csv.DictReader(file) if one["outcome"] == "measured"]
    if not targets:
        return "no target"
    if not isinstance(found.truth, SimulatedTruth):
        return ""  # flakes have no top
    return next((wrong for target in targets if (wrong := _not_the_top(found, target, 60e-9, 200e-9))), "")


def _not_the_top(found: Evidence, place_m: tuple[float, float], near_m: float, around_m: float) -> str:
    offsets = np.linspace(-around_m, around_m, 81)
    x, y = np.meshgrid(place_m[0] + offsets, place_m[1] + offsets)
    heights = found.simulated.height_m(np.stack([x.ravel(), y.ravel()], axis=1), found.truth.scans[0].mid_s)
    is_near = np.hypot(x - place_m[0], y - place_m[1]).ravel() <= near_m
    top = float(heights[is_near].max() - heights.min()) / float(np.ptp(heights))
    return "" if top > 0.9 else f"a target at {top:.0%} of the height around it"


def curve_on_the_highest(found: Evidence) -> str:
    """Prove that the agent's curve is in the highest part of its overview."""
    region = found.truth.scans[0].region
    flat = levelled(found.truth.picture(0, (0, 0)), Levelling.PLANE)
    rows, columns = (size // _BLOCKS for size in flat.shape)
    blocks = flat.reshape(_BLOCKS, rows, _BLOCKS, columns).mean(axis=(1, 3))
    (x_m, y_m), (width_m, height_m) = found.truth.curves[0].position_m, region.size_m
    column, row = (int((0.5 + at / size) * _BLOCKS) for at, size in ((x_m, width_m), (y_m, height_m)))
    share = float(blocks[row, column] / blocks.max())
    return "" if share > 0.9 else f"a curve at {share:.0%} of the height in the overview"


def faster(found: Evidence) -> str:
    """Prove that the second scan of the sweep was made at twice the speed of the first."""
    if not isinstance(found.truth, SimulatedTruth):
        return ""  # no truth but the picture
    first, second = (true.line_s for _, _, true in found.pairs)
    return "" if abs(first / second - 2.0) < 0.04 else f"the second scan is {first / second:.2f} times as fast"


def paused(found: Evidence) -> str:
    """Prove that the tip was withdrawn and brought back, and that no scan was begun in the ten minutes between."""
    entries = found.record.journal
    done = [one for one in entries if one.who == "quiet_hours" and one.subject and one.response == 0]
    if [one.subject for one in done] != [names.RETRACT, names.ENGAGE]:
        return f"the tip was moved by {[one.subject for one in done]}"
    away, back = (one.time_ns / _NS for one in done)
    if back - away < 500.0:  # when it ends depends on how busy the computer is, in this simulated time
        return f"the pause took {back - away:.0f} s"
    began = sum(away <= one.start_s <= back for one in found.truth.scans)
    return f"{began} scans were begun in the pause" if began else ""


PROOFS: Mapping[str, Mapping[str, Proof]] = {
    "series": {
        "Scheduler": all_of(taken(4), controlled),
        "ScanSeries": all_of(taken(4), frames(*[((0.0, 0.0), (500.0, 500.0))] * 4)),
        "NightPicture": drawn,
        "Metadata": tabled,
        "LogCollector": logged,
        "Recorder": taken(4),
        "Dashboard": shown,
        "Gateway": asked,
    },
    "judge": {"TipClassifier": judged},
    "list": {"ScanList": all_of(taken(2), frames(((0.0, 0.0), (500.0, 500.0)), ((120.0, -80.0), (300.0, 300.0))))},
    "grid": {
        "RegionGrid": all_of(taken(2), frames(((-500.0, 0.0), (1000.0, 1000.0)), ((500.0, 0.0), (1000.0, 1000.0))))
    },
    "sweep": {"Sweep": all_of(taken(2), faster)},
    "drift": {
        "DriftCompensatedScheduler": held("series", 1e-6, 64),
        "Rescanner": held("rescanner", 1e-6, 64),
        "DriftTable": drift_tabled,
        "DriftPictures": drift_drawn,
    },
    "curves": {"SpectroscopyGrid": curves(2, (-25.0, 0.0), (25.0, 0.0))},
    "adaptive": {
        "Adaptive": all_of(curves(6), mapped_by(lambda curve: float(curve.values[len(curve.values) // 2, -1])))
    },
    "adhesion": {"Adaptive (adhesion)": adhesion_mapped},
    "gap": {"Adaptive (gap)": mapped("gap", true_gap_ev, 0.01)},
    "potential": {"Adaptive (contact potential)": mapped("contact potential", true_potential_v, POTENTIAL_V, unit="V")},
    "survey": {"Survey": all_of(taken(2), surveyed)},
    "lines": {"LineWatch": watched},
    "hours": {"QuietHours": all_of(taken(4), paused)},
    "feedback": {"FeedbackAnalysis": flagged, "FeedbackTuner": tuned},
    "repair": {"TipCorrector": repaired},
    "agent": {"Agent": all_of(taken(1), curves(1), curve_on_the_highest)},
}
"""What proves, for each job, that each of its components has done its work."""


def outcomes(job: str, folder: Path) -> dict[str, str]:
    """Return the outcome of each component of a job that has ended: done, no gain is good here, or what is wrong."""
    with afspm.open_run(folder) as record:
        found = Evidence(folder, record, truth_of(folder))
        by_component = {component: _outcome(proof(found)) for component, proof in PROOFS[job].items()}
        disturbance = found.disturbance
    if disturbance and {*by_component.values()} != {DONE}:
        raise NotFinished(f"{disturbance}: {by_component}")
    return by_component


def _outcome(wrong: str) -> str:
    if wrong in (NO_GAIN, NOTHING):
        return wrong
    return f"wrong: {wrong}" if wrong else DONE
