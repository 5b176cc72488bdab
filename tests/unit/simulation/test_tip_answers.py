"""The hidden answers of the tip: drawn for each night, and given to treatments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from afspm.basics.errors import AfspmError, ConfigError
from afspm.simulation.tip import FLAWS
from afspm.simulation.tip_answers import KEY_FILE, PUBLIC_PRIORS, TipAnswers, answers_of, drawn_answers, sealed_priors
from afspm.simulation.world import World

HERE = (0.0, 0.0)


def cured(world: World, attempts: int, **pulse: float) -> float:
    """Return the share of pulses of a new flawed tip that cured it."""
    state = world.state()
    found = []
    for number in range(attempts):
        world.restore({**state, "calls": number})  # a draw of its own
        found.append(world.pulse(pulse["voltage_v"], 50e-3, 1.0) == "cured")
    return float(np.mean(found))


def world_of(condition: str, seed: int = 1, **changes: object) -> World:
    settings = {"tip": {"condition": condition}, "tip_changes": {"answers": "public", **changes}}
    return World.from_settings(settings, seed, 0.0)


def answers(seed: int) -> TipAnswers:
    found = answers_of("public", seed)
    assert found is not None
    return found


def test_answers_are_off_by_default_and_nights_keep_their_results() -> None:
    world = World.from_settings({"tip": {"condition": "double"}}, 3, 0.0)
    assert "tip_answers" not in world.truth(0.0)
    even = World.from_settings({"tip": {"condition": "double"}, "tip_changes": {"answers": "even"}}, 3, 0.0)
    outcomes = [[one.pulse(4.0, 0.1, float(t)) for t in range(20)] for one in (world, even)]
    assert outcomes[0] == outcomes[1]
    assert "cured" in outcomes[0]


@pytest.mark.parametrize("flaw", FLAWS)
def test_pulse_answers_by_flaw_and_polarity(flaw: str) -> None:
    world = world_of(flaw)
    one = answers(1).of((flaw,))
    for voltage_v in (5.0 * one.sign, -5.0 * one.sign):
        assert cured(world, 400, voltage_v=voltage_v) == pytest.approx(one.pulse(voltage_v)[0], abs=0.08)


def test_pulse_below_the_threshold_of_its_flaw_has_no_effect() -> None:
    one = answers(1).of(("contaminated",))
    below, above = 0.95 * one.threshold_v, 1.3 * one.threshold_v
    assert cured(world_of("contaminated"), 100, voltage_v=one.sign * below) == 0.0
    assert cured(world_of("contaminated"), 100, voltage_v=one.sign * above) > 0.0


def test_crash_cures_best_at_its_depth_and_worsens_more_below_it() -> None:
    one = answers(1).of(("blunt",))
    cures = [one.crash(depth * one.depth_m)[0] for depth in (0.25, 0.5, 1.0, 2.0, 4.0)]
    assert max(cures) == cures[2] == pytest.approx(one.crash_cures)
    worsens = [one.crash(depth * one.depth_m)[1] for depth in (0.5, 1.0, 2.0)]
    assert worsens == sorted(worsens)
    outcomes = []
    for number in range(300):
        world = world_of("blunt", answers_seed=1)
        world.restore({**world.state(), "calls": number})
        outcomes.append(world.crash(HERE, one.depth_m, 1.0, 1.0))
    assert np.mean([outcome == "cured" for outcome in outcomes]) == pytest.approx(one.crash_cures, abs=0.08)


def test_each_seed_has_answers_of_its_own_unless_a_seed_is_given_for_them() -> None:
    first, second = (world_of("double", seed).truth(0.0)["tip_answers"] for seed in (1, 2))
    assert first != second
    first, second = (world_of("double", seed, answers_seed=9).truth(0.0)["tip_answers"] for seed in (1, 2))
    assert first == second


def test_answers_survive_a_kill_and_turn_at_their_time() -> None:
    world = world_of("double", answers_turn_s=100.0)
    before = world.truth(99.0)["tip_answers"]
    again = world_of("double", answers_turn_s=100.0)
    again.restore(world.state())
    assert again.truth(99.0)["tip_answers"] == before
    assert again.truth(100.0)["tip_answers"] == answers(1).turned().truth()
    assert again.truth(100.0)["tip_answers"] != before


def test_probabilities_never_exceed_one() -> None:
    for seed in range(200):
        for one in answers(seed).of_flaw.values():
            both = [one.pulse(v) for v in (-10.0, -4.0, 4.0, 10.0)] + [one.crash(d) for d in (1e-9, 20e-9, 1e-6)]
            assert all(cures >= 0.0 and worsens >= 0.0 and cures + worsens <= 1.0 for cures, worsens in both)


def test_tip_with_several_flaws_answers_as_the_first() -> None:
    found = answers(1)
    assert found.of(("contaminated", "blunt")) is found.of_flaw["blunt"]
    assert found.of(()) is found.of_flaw["blunt"]


def test_draws_have_the_means_of_their_prior() -> None:
    drawn = [drawn_answers(PUBLIC_PRIORS, seed).of_flaw["contaminated"] for seed in range(600)]
    prior = PUBLIC_PRIORS["contaminated"]
    assert np.mean([one.pulse_cures for one in drawn]) == pytest.approx(prior.pulse_cures, abs=0.02)
    assert np.mean([one.sign > 0 for one in drawn]) == pytest.approx(prior.plus, abs=0.05)
    assert np.median([one.threshold_v for one in drawn]) == pytest.approx(prior.threshold_v, rel=0.03)


def test_sealed_priors_follow_from_the_key_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key = tmp_path / "key"
    key.write_bytes(b"the first key\n")
    monkeypatch.setenv(KEY_FILE, str(key))
    first = answers_of("sealed", 1)
    assert first is not None
    assert first.truth() == drawn_answers(sealed_priors(b"the first key"), _seed(1)).truth()
    key.write_bytes(b"another key")
    second = answers_of("sealed", 1)
    assert second is not None
    assert second.truth() != first.truth()
    assert sealed_priors(b"the first key") != PUBLIC_PRIORS


@pytest.mark.parametrize("content", [None, b"", b" \n"])
def test_sealed_answers_without_a_key_are_refused(
    content: bytes | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "key"
    if content is not None:
        path.write_bytes(content)
    monkeypatch.setenv(KEY_FILE, str(path))
    with pytest.raises(ConfigError, match="key"):
        World.from_settings({"tip_changes": {"answers": "sealed"}}, 1, 0.0)
    monkeypatch.delenv(KEY_FILE)
    with pytest.raises(ConfigError, match="need a key"):
        World.from_settings({"tip_changes": {"answers": "sealed"}}, 1, 0.0)


def test_unknown_answers_are_refused() -> None:
    with pytest.raises(AfspmError, match="unknown: 'publik'"):
        World.from_settings({"tip_changes": {"answers": "publik"}}, 1, 0.0)


def _seed(seed: int) -> int:
    from afspm.simulation import chance

    return chance.subseed(seed, "sealed")
