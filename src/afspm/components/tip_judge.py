"""The judge of the tip, which compares scans with a reference learnt from the first scans.

At a known place the judge compares like with like, and detects small changes. Its reference there follows the good
scans, since the sample drifts; the first scans stay as the measure of slow wear. Elsewhere it detects only changes that
no place explains: a large loss of detail, or debris. At an unknown place a ghost image looks like order of the sample.

Scans of another size or number of pixels have a reference of their own, since the effect of a tip on a scan depends on
the pixel: a fault in a zoom may be finer than the pixels of an overview. So have scans with another bias, setpoint,
speed or gain: the first scan of a place at four times the speed looks blunt. A reference is begun only while all others
show a good tip, and a fault found in one kind of scan is over only when an equally fine kind shows none.

Measured on simulated nights (128 x 128 pixels, 8 seeds, slow drift, one scan judged by itself, known places):

    sample      good called bad    double / blunt / with debris called good
    particles        0 of 80             0 / 0 / 0 of 16
    stamper          0 of 80             0 / 0 / 0 of 16
    rough            0 of 80             2 / 16 / 0 of 16      a blunt tip hardly changes gentle slopes
    steps            3 of 80            10 / 10 / 0 of 16      0.4 nm high, 0.05 nm of noise: ask for two in a row

Three kinds in turns (2 um and 500 nm at 128 x 128, 800 nm at 96 x 96, 2 seeds): of 32 good scans of each kind none was
called bad at 2 um and 500 nm, and one (stamper) at 800 nm; of 6 scans of each fault and kind none was called good on
particles and stamper. On rough ground and steps only debris was detected, as above.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from types import MappingProxyType

import numpy as np

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.basics.formatting import area_text
from afspm.basics.plain_data import Plain
from afspm.components.tip_metrics import (
    LEAST_CONTRAST,
    TipMetrics,
    autocorrelation,
    metrics,
    share_at_ends,
    slopes,
)
from afspm.model import Region
from afspm.model.arrays import Array, robust_spread
from afspm.model.caption import are_alike
from afspm.model.snapshot import from_plain, to_plain

REACH_PX = 32  # search range for the second apex of a double tip
SAME_SIZE = 0.02  # relative difference within which sizes count as equal
SAME_PLACE = 0.2  # share of the size within which a centre counts as the same place
# limits the saved state: each place keeps an autocorrelation of 33 x 65 values
MOST_PLACES = 16
DECIMALS = 4  # of an autocorrelation, to limit the saved state
MOST_KINDS = 4  # of scans with a reference at the same time
FOLLOW = 0.25  # least weight of a new good scan in the means of its place
LEVEL_NOISES = 3.0  # standard deviations between stretches of a line, with a good tip
NOISIER = 2.0  # times the usual noise, above which only unrest shows that a tip is bad
UNCERTAIN = 0.99  # of the way to a limit
FEWEST_AT_END = 0.005  # share of the pixels at the highest or lowest value of a scan that ends at its range
FLOORS = TipMetrics(detail=0.02, ghost=0.01, unrest_m=0.15, contrast=0.0)  # least spreads: few scans underestimate them
NO_SETTINGS: Mapping[str, float] = MappingProxyType({})
Fault = tuple[float, str, str]
"""A fault: its size relative to the limit for a bad scan (1), the flaw, and the reason."""
BLUNT, DOUBLE, CONTAMINATED = FLAWS = ("blunt", "double", "contaminated")


class Opinion(Enum):
    """Opinion on the tip after a scan."""

    LEARNING = "learning"
    GOOD = "good"
    BAD = "bad"
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Verdict:
    """Opinion on one scan, with a reason for people.

    Attributes:
        flaws: the visible flaws of a bad tip, a subset of `FLAWS`; flaws that hide others come first.
    """

    opinion: Opinion
    why: str
    metrics: TipMetrics | None = None
    flaws: tuple[str, ...] = ()


@dataclass(frozen=True)
class TipTolerance:
    """Deviations from the reference within which a tip counts as good.

    Attributes:
        detail: at a known place, the least share of the fine detail.
        ghost: at a known place, the largest correlation of a ghost image.
        unrest: factor on the disagreement of trace and retrace in single stretches of flat ground.
        worn: at any place, the least share of the first scans' fine detail.
        sigmas: least deviation of a bad scan, in standard deviations of the reference; not for `worn`.
        margin: a scan within this share of the way to a limit is good; from there to the limit a scan is unclear, so
            that the opinion on a tip at the limit does not alternate.
    """

    detail: float = 0.85
    ghost: float = 0.08
    unrest: float = 2.0
    worn: float = 0.55
    sigmas: float = 5.0
    margin: float = 0.8

    def __post_init__(self) -> None:
        shares = (self.detail, self.ghost, self.worn, self.margin)
        if not all(0 < share < 1 for share in shares) or self.unrest <= 1 or self.sigmas < 0:
            raise ConfigError(
                f"the tolerances are out of range: {asdict(self)}",
                hint="detail, ghost, worn and margin between 0 and 1, unrest above 1, sigmas not below 0",
            )


@dataclass
class KnownPlace:
    """The usual metrics of a region in scans with a good tip.

    Attributes:
        center_m: the centre in the coordinates of the scans.
        usual: mean metrics.
        expected: mean autocorrelation of the slopes.
        scans: number of scans in the means.
    """

    center_m: tuple[float, float]
    usual: TipMetrics
    expected: Array
    scans: int = 1

    def follow(self, measured: TipMetrics, correlation: Array) -> None:
        """Add a good scan to the means: equal weights at first, then at least FOLLOW for the newest."""
        weight = max(FOLLOW, 1.0 / (self.scans + 1))
        self.expected = np.round(self.expected + weight * (correlation - self.expected), DECIMALS)
        now, new = asdict(self.usual), asdict(measured)
        self.usual = TipMetrics(**{name: now[name] + weight * (new[name] - now[name]) for name in now})
        self.scans += 1


@dataclass
class TipReference:
    """The reference for one kind of scan (same size, angle, shape and settings), from scans with a good tip.

    Attributes:
        size_m, angle_rad, shape: size, angle and shape of these scans.
        settings: their bias, setpoint and speed, and gains of the run, as far as known.
        places: the places of these scans, the last seen at the end.
        first: metrics of the scans that were learnt from.
        deviations: differences of such scans at the same place: detail and unrest as ratios, ghost unchanged.
        suspect: whether a fault was found at a known place and is not over yet.
        confirmed: whether a scan of any kind was judged good after the last scan that was learnt from.
    """

    size_m: tuple[float, float]
    angle_rad: float
    shape: tuple[int, int]
    places: list[KnownPlace] = field(default_factory=list)
    first: list[TipMetrics] = field(default_factory=list)
    deviations: list[TipMetrics] = field(default_factory=list)
    suspect: bool = False
    confirmed: bool = False
    settings: Mapping[str, float] = field(default_factory=dict)

    @property
    def pixel_m(self) -> float:
        return max(size / pixels for size, pixels in zip(self.size_m, reversed(self.shape), strict=True))

    def fits(self, region: Region, shape: tuple[int, int], settings: Mapping[str, float]) -> bool:
        by = self._at(region.center_m).compared(region)
        is_alike = shape == self.shape and are_alike(settings, self.settings)
        return max(by.size, abs(by.turned_rad)) < SAME_SIZE and is_alike

    def _at(self, center_m: tuple[float, float]) -> Region:
        return Region(center_m, self.size_m, self.angle_rad)

    def place(self, region: Region) -> KnownPlace | None:
        """Return the known place at a region; None if there is none."""
        for place in reversed(self.places):
            if self._at(place.center_m).compared(region).apart < SAME_PLACE:
                return place
        return None

    def note(self, place: KnownPlace | None, region: Region, measured: TipMetrics, correlation: Array) -> None:
        """Add a scan with a good tip to a place; None as `place` begins a new place."""
        if place is not None:
            place.follow(measured, correlation)
            return
        self.places.append(KnownPlace(region.center_m, replace(measured, ghost=0.0), np.round(correlation, DECIMALS)))
        del self.places[:-MOST_PLACES]

    def spread(self, name: str) -> float:
        """Return the standard deviation of a metric of good scans at one place: relative for detail and unrest."""
        floor: float = getattr(FLOORS, name)
        if len(self.deviations) < 2:
            return floor
        values = np.array([getattr(d, name) for d in self.deviations])
        return max(floor, robust_spread(values))

    def usual_anywhere(self) -> TipMetrics:
        """Return the median metrics of the scans that were learnt from."""
        names = asdict(self.first[0])
        return TipMetrics(
            **{name: float(np.median([getattr(measured, name) for measured in self.first])) for name in names}
        )


@dataclass
class JudgeState:
    """The state of a judge that survives a restart.

    Attributes:
        kinds: references, complete and incomplete, the last used at the end.
        doubtful: whether the last scan that was compared with a reference was bad or unclear.
    """

    kinds: list[TipReference] = field(default_factory=list)
    doubtful: bool = False


class TipJudge:
    """A judge that learns a reference from the first scans of each kind, and compares later scans with it.

    Args:
        reference_scans: number of scans to learn from. The tip must be good then, which the scans alone can't show.
        tolerance: limits for a good tip.
    """

    def __init__(self, reference_scans: int, tolerance: TipTolerance | None = None) -> None:
        if reference_scans < 2:
            raise ConfigError(f"{reference_scans} reference scans give no spread", hint="at least 2", where="tip")
        self.reference_scans = reference_scans
        self.tolerance = tolerance or TipTolerance()
        self._state = JudgeState()

    @property
    def kinds(self) -> tuple[TipReference, ...]:
        """References, complete and incomplete, the last used at the end."""
        return tuple(self._state.kinds)

    def knows(self, region: Region, shape: tuple[int, int], settings: Mapping[str, float] = NO_SETTINGS) -> bool:
        """Return whether the reference for scans of this size, angle, shape and settings is complete."""
        return any(self._is_known(kind) and kind.fits(region, shape, settings) for kind in self._state.kinds)

    def state(self) -> Plain:
        """Return the state to save, in JSON's types."""
        plain: Plain = to_plain(self._state, lists=True)
        return plain

    def restore(self, state: Plain) -> None:
        self._state = from_plain(JudgeState, state)

    def trust(self) -> None:
        """Drop all suspicion: the tip was treated, and only later scans can show that it is bad."""
        self._state.doubtful = False
        for kind in self._state.kinds:
            kind.suspect = False

    def judge(
        self,
        trace: Array,
        retrace: Array | None,
        region: Region,
        *,
        settings: Mapping[str, float] = NO_SETTINGS,
        learns: bool = True,
    ) -> Verdict:
        """Return the verdict on a scan.

        Args:
            trace, retrace: heights in m, [y, x]; retrace None if not recorded.
            region: the scanned region.
            settings: `caption.picture_settings` of the scan.
            learns: whether a scan may be added to an incomplete reference, or begin one.
        """
        shape = (trace.shape[0], trace.shape[1])
        if not self.knows(region, shape, settings) and not (learns and self._is_trusted):
            of = _kind_text(region, shape)
            why = f"no reference of {of} with these settings, and none is begun while the tip may be bad"
            return Verdict(Opinion.UNCLEAR, why)
        try:
            seen_slopes = slopes(trace, retrace)
        except InvalidValue as error:
            return Verdict(Opinion.UNCLEAR, error.what)
        kind = self._reference_for(region, shape, settings)
        place = kind.place(region)
        correlation = autocorrelation(seen_slopes, min(REACH_PX, min(shape) // 3))
        measured = metrics(seen_slopes, correlation, place.expected if place else None)
        if measured.contrast < LEAST_CONTRAST:
            return Verdict(Opinion.UNCLEAR, f"nothing to see but noise (contrast {measured.contrast:.2f})", measured)
        if measured.ghost > 1.0:  # trace and retrace agree more at another place than at their own
            why = "trace and retrace do not agree: the feedback does not follow the surface at this speed"
            return Verdict(Opinion.UNCLEAR, why, measured)
        if not self._is_known(kind):
            return self._learn(kind, place, measured, correlation, region)
        verdict = self._compare(kind, place, measured, at_end=share_at_ends(trace))
        self._state.doubtful = verdict.opinion is not Opinion.GOOD
        if verdict.opinion is Opinion.GOOD:
            kind.note(place, region, measured, correlation)
            for other in self._state.kinds:
                other.confirmed = True
        elif verdict.opinion is Opinion.BAD:
            # scans learnt from since the last good comparison may show the bad tip
            self._state.kinds = [other for other in self._state.kinds if other.confirmed or other is kind]
        return verdict

    @property
    def _is_trusted(self) -> bool:
        return not self._state.doubtful and not any(kind.suspect for kind in self._state.kinds)

    def _is_known(self, kind: TipReference) -> bool:
        return len(kind.first) >= self.reference_scans

    def _reference_for(self, region: Region, shape: tuple[int, int], settings: Mapping[str, float]) -> TipReference:
        kinds = self._state.kinds
        kind = next((known for known in kinds if known.fits(region, shape, settings)), None)
        if kind is not None:
            kinds.remove(kind)
        elif len(kinds) >= MOST_KINDS:
            kinds.remove(next((known for known in kinds if not self._is_known(known)), kinds[0]))
        kind = kind or TipReference(region.size_m, region.angle_rad, shape, settings=dict(settings))
        kinds.append(kind)
        return kind

    def _learn(
        self,
        reference: TipReference,
        place: KnownPlace | None,
        measured: TipMetrics,
        correlation: Array,
        region: Region,
    ) -> Verdict:
        if place is not None:
            reference.deviations.append(_relative(measured, place.usual))
        reference.first.append(measured)
        reference.confirmed = False
        reference.note(place, region, measured, correlation)
        of = _kind_text(region, reference.shape)
        return Verdict(
            Opinion.LEARNING, f"reference {len(reference.first)} of {self.reference_scans} of {of}", measured
        )

    def _compare(
        self, reference: TipReference, place: KnownPlace | None, measured: TipMetrics, *, at_end: float
    ) -> Verdict:
        faults = self._faults_anywhere(reference, measured)
        usual = reference.usual_anywhere()
        if place is not None:
            faults += self._faults_here(reference, place, measured)
            usual = place.usual
        noisier = _relative(measured, usual).noise_m
        if noisier > NOISIER:  # strong noise changes the other metrics, too
            faults = _uncertain(faults, f"in {noisier:.1f} times the noise")
        if at_end > FEWEST_AT_END:  # the same cut through all features looks like a ghost, or as lost detail
            faults = _uncertain(faults, f"with {at_end:.1%} of the pixels at the end of the range of heights")
        worst = max(way for way, _, _ in faults)
        if worst >= 1.0:
            reference.suspect = reference.suspect or place is not None
            certain = [(flaw, why) for way, flaw, why in faults if way >= 1.0]
            flaws = tuple(flaw for flaw in FLAWS if flaw in dict(certain))
            return Verdict(Opinion.BAD, "; ".join(why for _, why in certain), measured, flaws)
        if worst > self.tolerance.margin:
            return Verdict(
                Opinion.UNCLEAR,
                "nearly " + "; ".join(why for way, _, why in faults if way > self.tolerance.margin),
                measured,
            )
        if place is not None:
            self._clear_suspicion(reference)
        if any(kind.suspect for kind in self._state.kinds):
            missing = "there is no reference of this place" if place is None else "a finer kind of scan showed a fault"
            return Verdict(Opinion.UNCLEAR, f"nothing wrong, but {missing}", measured)
        return Verdict(Opinion.GOOD, _summary(measured, place.usual if place else reference.usual_anywhere()), measured)

    def _clear_suspicion(self, by: TipReference) -> None:
        # only a comparison at least as fine as the one that found the fault can clear it
        for kind in self._state.kinds:
            kind.suspect = kind.suspect and by.pixel_m > (1.0 + SAME_SIZE) * kind.pixel_m

    def _faults_anywhere(self, reference: TipReference, measured: TipMetrics) -> list[Fault]:
        usual, tolerance = reference.usual_anywhere(), self.tolerance
        now = _relative(measured, usual)
        worn = f"worn: {now.detail:.0%} of the first scans' fine detail is left"
        faults = [((1.0 - now.detail) / (1.0 - tolerance.worn), BLUNT, worn)]
        if measured.unrest_m > 0.0:  # zero without retrace
            limit = 1.0 + max(tolerance.unrest - 1.0, tolerance.sigmas * reference.spread("unrest_m"))
            what = f"{measured.unrest_m * 1e9:.2f} nm instead of {usual.unrest_m * 1e9:.2f} nm"
            faults.append(
                ((now.unrest_m - 1.0) / (limit - 1.0), CONTAMINATED, f"unsteady: trace and retrace disagree by {what}")
            )
        return faults

    def _faults_here(self, reference: TipReference, place: KnownPlace, measured: TipMetrics) -> list[Fault]:
        tolerance, now = self.tolerance, _relative(measured, place.usual)
        loss = max(1.0 - tolerance.detail, tolerance.sigmas * reference.spread("detail"))
        ghost = max(tolerance.ghost, tolerance.sigmas * reference.spread("ghost"))
        blunt = (1.0 - now.detail) / loss
        # a blunt tip widens every feature, which the autocorrelation shows as well: then it is no ghost
        what = "broad features" if blunt >= 1.0 else "double: a ghost image"
        shadow = max(0.0, now.ghost - place.usual.ghost) / ghost
        return [
            (blunt, BLUNT, f"blunt: {now.detail:.0%} of the fine detail here is left"),
            (shadow, BLUNT if blunt >= 1.0 else DOUBLE, f"{what} with correlation {now.ghost:.2f}"),
        ]


def _uncertain(faults: list[Fault], why_not: str) -> list[Fault]:
    return [
        (way if flaw == CONTAMINATED else min(way, UNCERTAIN), flaw, f"{why} {why_not}") for way, flaw, why in faults
    ]


class VerdictCounter:
    """A counter of opinions: several bad opinions in a row set the flag, several good opinions clear it."""

    def __init__(self, flag_after: int, clear_after: int) -> None:
        if flag_after < 1 or clear_after < 1:
            raise ConfigError("`flag_after` and `clear_after` must be at least 1")
        self.flag_after, self.clear_after = flag_after, clear_after
        self.bad = self.good = 0

    def count(self, opinion: Opinion) -> None:
        """Count an opinion. UNCLEAR neither counts nor interrupts a row."""
        if opinion is Opinion.BAD:
            self.bad, self.good = self.bad + 1, 0
        elif opinion is Opinion.GOOD:
            self.bad, self.good = 0, self.good + 1

    @property
    def wants_flag(self) -> bool:
        return self.bad >= self.flag_after

    @property
    def wants_clear(self) -> bool:
        return self.good >= self.clear_after


def _kind_text(region: Region, shape: tuple[int, int]) -> str:
    return f"scans of {area_text(region.size_m)}, {shape[1]} x {shape[0]} pixels"


def _relative(measured: TipMetrics, usual: TipMetrics) -> TipMetrics:
    # ghost and contrast are correlations already, and need no usual value
    own = LEVEL_NOISES * usual.noise_m
    unrest = (measured.unrest_m + own) / (usual.unrest_m + own) if own > 0 else 1.0
    noise = measured.noise_m / usual.noise_m if usual.noise_m > 0 else 1.0
    # without fine detail above the noise, as on some lattices, its power is noise
    fine = usual.contrast * usual.detail / (1.0 + usual.detail)
    detail = measured.detail / usual.detail if fine > LEAST_CONTRAST else 1.0
    return TipMetrics(detail, measured.ghost, unrest, measured.contrast, noise)


def _summary(measured: TipMetrics, usual: TipMetrics) -> str:
    detail, unrest_nm = _relative(measured, usual).detail, measured.unrest_m * 1e9
    return f"detail {detail:.0%}, ghost {measured.ghost:.2f}, unrest {unrest_nm:.2f} nm"
