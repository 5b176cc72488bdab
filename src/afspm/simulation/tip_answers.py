"""The hidden answers of the tip: each flaw's response to pulses and crashes, drawn once per night.

**Theory of operation.** A prior states, for each flaw, which treatments usually cure it. The answers of one night are
one draw from the prior: a component that repairs tips can learn the draw within the night, and the prior from night to
night. The parameters of the "public" prior are in this module and in the documentation. The parameters of the "sealed"
prior are drawn with a key outside of the repository, so that no component can be tuned to them.

All of it is simulated, without a source. The pictures behind it: the field of a pulse desorbs debris, or moves atoms of
the apex, at one polarity more than at the other, above a threshold; a crash reshapes the apex where the depth fits the
size of the flaw, and a deeper crash adds flaws. A policy that does well here can learn such answers; nothing is shown
about tips of tungsten. The default is "even", so that recorded nights keep their results.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from afspm.basics.errors import ConfigError
from afspm.simulation import chance

ANSWER_KINDS = ("even", "public", "sealed")
KEY_FILE = "AFSPM_SEALED_KEY_FILE"
"""The environment variable with the path of the file whose content is the key of the sealed prior. The variable itself
would show the key in the list of processes of every child."""
MOST_WORSENS = 0.6


@dataclass(frozen=True)
class Answers:
    """The response of one flaw to treatments.

    Attributes:
        threshold_v: voltage below which no pulse has an effect.
        pulse_cures: probability that a pulse of the better polarity, far above the threshold, cures.
        other_polarity: factor on that probability for the other polarity.
        pulse_worsens: probability that a strong pulse adds a flaw; doubled for the other polarity.
        depth_m: depth at which a crash cures best.
        crash_cures: probability that a crash of that depth cures.
        crash_worsens: probability that a crash of that depth adds a flaw, in proportion to the depth.
    """

    threshold_v: float
    pulse_cures: float
    other_polarity: float
    pulse_worsens: float
    depth_m: float
    crash_cures: float
    crash_worsens: float


@dataclass(frozen=True)
class AnswerPrior(Answers):
    """The distribution of one flaw's answers: medians of voltage and depth, means of probabilities and factor.

    Attributes:
        plus: probability that positive pulses cure better than negative pulses.
    """

    plus: float


PUBLIC_PRIORS: Mapping[str, AnswerPrior] = {
    "blunt": AnswerPrior(4.0, 0.1, 0.3, 0.06, 18e-9, 0.85, 0.05, plus=0.5),
    "double": AnswerPrior(3.2, 0.7, 0.1, 0.08, 8e-9, 0.3, 0.08, plus=0.2),
    "contaminated": AnswerPrior(2.2, 0.8, 0.1, 0.06, 5e-9, 0.15, 0.1, plus=0.85),
}
_SPREAD_LOG = 0.15  # of thresholds and depths, in ln
_DEPTH_LOG = 0.6  # width of the depths that cure, in ln
_CERTAINTY = 12.0  # of probabilities: a beta distribution of the prior's mean and this many counts


@dataclass(frozen=True)
class FlawAnswers(Answers):
    """The response of one flaw in one night.

    Attributes:
        sign: sign of the voltage of the better pulses.
    """

    sign: float

    def pulse(self, voltage_v: float) -> tuple[float, float]:
        """Return the probabilities (cured, worsened) of a pulse of the usual duration."""
        above = abs(voltage_v) / self.threshold_v - 1.0
        if above <= 0.0:
            return 0.0, 0.0
        effect, better = 1.0 - math.exp(-4.0 * above), voltage_v * self.sign > 0.0
        cures = effect * self.pulse_cures * (1.0 if better else self.other_polarity)
        return cures, min(MOST_WORSENS, 1.0 - cures, self.pulse_worsens * above * (1.0 if better else 2.0))

    def crash(self, depth_m: float) -> tuple[float, float]:
        """Return the probabilities (cured, worsened) of a crash at the usual speed."""
        off = math.log(depth_m / self.depth_m) / _DEPTH_LOG
        cures = self.crash_cures * math.exp(-0.5 * off * off)
        return cures, min(MOST_WORSENS, 1.0 - cures, self.crash_worsens * depth_m / self.depth_m)


class TipAnswers:
    """The answers of all flaws.

    A tip with several flaws answers as its first flaw in the order blunt, double, contaminated, since a missing apex
    hides the other flaws. A sharp tip answers like a blunt tip, and has no flaw to cure.
    """

    def __init__(self, of_flaw: Mapping[str, FlawAnswers]) -> None:
        self.of_flaw = dict(of_flaw)

    def of(self, flaws: Sequence[str]) -> FlawAnswers:
        return next(self.of_flaw[flaw] for flaw in (*PUBLIC_PRIORS, "blunt") if flaw in flaws or not flaws)

    def turned(self) -> TipAnswers:
        """Return the answers with the polarity reversed, and with pulse and crash cure probabilities swapped."""
        return TipAnswers({
            flaw: replace(one, sign=-one.sign, pulse_cures=one.crash_cures, crash_cures=one.pulse_cures)
            for flaw, one in self.of_flaw.items()
        })  # fmt: skip

    def truth(self) -> dict[str, object]:
        return {flaw: asdict(one) for flaw, one in self.of_flaw.items()}


def drawn_answers(priors: Mapping[str, AnswerPrior], seed: int) -> TipAnswers:
    """Draw the answers of one night from the priors."""
    of_flaw = {}
    for number, (flaw, prior) in enumerate(priors.items()):
        random = chance.generator(seed, number)

        def probability(mean: float, random: np.random.Generator = random) -> float:
            return float(random.beta(_CERTAINTY * mean, _CERTAINTY * (1.0 - mean)))

        def scale(median: float, random: np.random.Generator = random) -> float:
            return median * math.exp(_SPREAD_LOG * float(random.normal()))

        of_flaw[flaw] = FlawAnswers(
            sign=1.0 if random.random() < prior.plus else -1.0,
            threshold_v=scale(prior.threshold_v),
            pulse_cures=probability(prior.pulse_cures),
            other_polarity=probability(prior.other_polarity),
            pulse_worsens=probability(prior.pulse_worsens),
            depth_m=scale(prior.depth_m),
            crash_cures=probability(prior.crash_cures),
            crash_worsens=probability(prior.crash_worsens),
        )
    return TipAnswers(of_flaw)


def sealed_priors(key: bytes) -> Mapping[str, AnswerPrior]:
    """Return the priors of a key: the public values, permuted over the flaws and scattered."""
    random = np.random.default_rng(list(hmac.digest(key, b"afspm tip answers, sealed half", hashlib.sha256)))
    public = list(PUBLIC_PRIORS.values())
    of_pulses, of_crashes = random.permutation(len(public)), random.permutation(len(public))

    def about(value: float) -> float:
        return float(value * random.uniform(0.85, 1.15))

    priors = {}
    for flaw, pulse_of, crash_of in zip(PUBLIC_PRIORS, of_pulses, of_crashes, strict=True):
        pulse, crash = public[pulse_of], public[crash_of]
        priors[flaw] = AnswerPrior(
            plus=float(random.uniform(0.1, 0.9)),
            threshold_v=about(pulse.threshold_v),
            pulse_cures=about(pulse.pulse_cures),
            other_polarity=about(pulse.other_polarity),
            pulse_worsens=about(pulse.pulse_worsens),
            depth_m=about(crash.depth_m),
            crash_cures=about(crash.crash_cures),
            crash_worsens=about(crash.crash_worsens),
        )
    return priors


def answers_of(kind: str, seed: int) -> TipAnswers | None:
    """Return the answers for a setting and a night's seed; None for "even".

    Raises:
        ConfigError: "sealed" without a key.
    """
    if kind == "even":
        return None
    return drawn_answers(PUBLIC_PRIORS if kind == "public" else sealed_priors(_key()), chance.subseed(seed, kind))


def _key() -> bytes:
    path = os.environ.get(KEY_FILE)
    hint = f"set {KEY_FILE} to the path of a file with any content, the key"
    if not path:
        raise ConfigError("the sealed answers need a key", where="tip_changes.answers", hint=hint)
    try:
        key = Path(path).read_bytes().strip()
    except OSError as error:
        raise ConfigError(f"the key can't be read: {error}", where="tip_changes.answers", hint=hint) from error
    if not key:
        raise ConfigError(f"the key file {path} is empty", where="tip_changes.answers", hint=hint)
    return key
