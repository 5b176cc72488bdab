"""Verdicts on tips by their scans, against a simulation with known tips."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from tests.unit.components.tip_scans_lab import ELSEWHERE, HOME, PIXELS, channels

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.components.tip_judge import Opinion, TipJudge, TipTolerance, Verdict, VerdictCounter
from afspm.components.tip_metrics import autocorrelation, ghost, slopes
from afspm.model import Region, Scan, names

LEARN = 3
FLAWS = ("double", "blunt", "contaminated")


def judged(judge: TipJudge, pair: tuple[Scan, Scan]) -> Verdict:
    return judge.judge(pair[0].values, pair[1].values, pair[0].region)


def learnt(
    seed: int, condition: str, number: int = 5
) -> tuple[TipJudge, list[tuple[Scan, Scan]], list[tuple[Scan, Scan]]]:
    """Return a judge with a reference, further scans with the good tip, and scans with the changed one."""
    pairs = channels(seed, condition, number)
    judge = TipJudge(LEARN)
    for pair in pairs[:LEARN]:
        assert judged(judge, pair).opinion is Opinion.LEARNING
    return judge, list(pairs[LEARN:number]), list(pairs[number:])


def at_home(pairs: list[tuple[Scan, Scan]]) -> list[tuple[Scan, Scan]]:
    found = [pair for pair in pairs if pair[0].region == HOME]
    assert found
    return found


@pytest.mark.parametrize("condition", FLAWS)
@pytest.mark.parametrize("seed", range(2))
def test_judge_distinguishes_good_from_changed_tips_at_known_places(seed: int, condition: str) -> None:
    judge, good, bad = learnt(seed, condition)
    for pair in at_home(good):
        assert judged(judge, pair).opinion is Opinion.GOOD
    for pair in at_home(bad):
        assert judged(judge, pair).opinion is Opinion.BAD


@pytest.mark.parametrize(
    ("condition", "word"), [("double", "double"), ("blunt", "blunt"), ("contaminated", "blunt|unsteady")]
)
def test_verdict_names_the_fault(condition: str, word: str) -> None:
    judge, _, bad = learnt(1, condition)
    assert any(part in judged(judge, bad[0]).why for part in word.split("|"))


@pytest.mark.parametrize("seed", range(2))
def test_an_unknown_place_does_not_make_a_good_tip_bad(seed: int) -> None:
    judge, good, _ = learnt(seed, "double")
    elsewhere = [pair for pair in good if pair[0].region == ELSEWHERE]
    assert elsewhere
    assert all(judged(judge, pair).opinion is not Opinion.BAD for pair in elsewhere)


@pytest.mark.parametrize("condition", FLAWS)
@pytest.mark.parametrize("seed", range(2))
def test_fault_found_at_a_known_place_is_not_cleared_elsewhere(seed: int, condition: str) -> None:
    judge, _, bad = learnt(seed, condition)
    assert judged(judge, bad[0]).opinion is Opinion.BAD
    assert bad[-1][0].region == ELSEWHERE
    assert judged(judge, bad[-1]).opinion is not Opinion.GOOD


def disturbed(pair: tuple[Scan, Scan], what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights of a scan in another room."""
    random = np.random.default_rng(7)
    both = [scan.values.copy() for scan in pair]
    time = 2.0 * PIXELS * np.arange(PIXELS)[:, None] + np.arange(PIXELS)
    for values, at in zip(both, (time, time[:, ::-1] + PIXELS), strict=True):
        if what == "hum":
            values += 2e-9 * np.sin(2.0 * np.pi * at / 37.0)
        elif what == "noise":
            values += 1.5e-9 * random.standard_normal(values.shape)
        elif what == "zero rows":  # of a tilted sample, in which a row of zeros is a ramp
            values += 50e-9 * np.linspace(-1.0, 1.0, PIXELS)
            values[random.permutation(PIXELS)[:9]] = 0.0
        elif what == "the end of the range":
            np.minimum(values, np.quantile(both[0], 0.95), out=values)
        else:
            for row in range(PIXELS):
                if random.random() < 0.6:
                    first = int(random.integers(PIXELS - 10))
                    values[row, first : first + 30] += 4e-9
    return both[0], both[1]


@pytest.mark.parametrize("what", ["hum", "noise", "zero rows", "the end of the range"])
def test_noise_hum_lost_rows_and_cut_heights_are_no_bad_tip(what: str) -> None:
    judge, good, _ = learnt(1, "double")
    verdict = judge.judge(*disturbed(good[0], what), HOME)
    assert verdict.opinion is not Opinion.BAD, verdict.why


def test_streaks_are_a_bad_tip() -> None:
    judge, good, _ = learnt(1, "double")
    verdict = judge.judge(*disturbed(good[0], "streaks"), HOME)
    assert verdict.flaws == ("contaminated",), verdict.why


def test_trace_and_retrace_of_different_places_are_unclear() -> None:
    judge, good, _ = learnt(1, "double")
    trace, retrace = (scan.values for scan in good[0])
    verdict = judge.judge(trace, np.roll(retrace, 24, axis=1), good[0][0].region)
    assert verdict.opinion is Opinion.UNCLEAR
    assert "trace and retrace do not agree" in verdict.why


def test_reference_survives_a_restart() -> None:
    judge, good, bad = learnt(2, "double")
    again = TipJudge(LEARN)
    again.restore(json.loads(json.dumps(judge.state())))
    for pair in (good[0], bad[0], bad[-1]):
        before, after = judged(judge, pair), judged(again, pair)
        assert (before.opinion, before.why) == (after.opinion, after.why)


def test_a_sample_so_smooth_that_its_first_scans_had_no_fine_detail_is_judged_by_the_rest() -> None:
    judge, left, _ = learnt(1, "blunt")
    state = judge.state()
    (kind,) = state["kinds"]
    for seen in (*kind["first"], *(place["usual"] for place in kind["places"])):
        seen["detail"] = 0.0
    judge.restore(state)
    assert judged(judge, left[0]).opinion is Opinion.GOOD


def test_fine_detail_below_the_noise_is_no_measure_of_the_tip() -> None:
    judge, left, _ = learnt(1, "blunt")
    state = judge.state()
    (kind,) = state["kinds"]
    detail = 3.0 * kind["first"][0]["detail"]
    for contrast, expected in ((100.0, Opinion.BAD), (0.1, Opinion.GOOD)):
        for seen in (*kind["first"], *(place["usual"] for place in kind["places"])):
            seen["detail"], seen["contrast"] = detail, contrast
        judge.restore(state)
        assert judged(judge, left[0]).opinion is expected


def test_double_tip_is_detected_without_retrace() -> None:
    pairs = channels(1, "double", 5)
    judge = TipJudge(LEARN)
    opinions = [judge.judge(trace.values, None, trace.region).opinion for trace, _ in pairs[:4] + pairs[5:7]]
    assert opinions[LEARN:] == [Opinion.GOOD, Opinion.BAD, Opinion.BAD]


def test_scan_of_pure_noise_is_unclear() -> None:
    random = np.random.default_rng(1)
    noise = random.normal(size=(2, PIXELS, PIXELS)) * 1e-10
    assert TipJudge(LEARN).judge(noise[0], noise[1], HOME).opinion is Opinion.UNCLEAR


def zoom_of(pair: tuple[Scan, Scan]) -> tuple[np.ndarray, np.ndarray, Region]:
    """Return the middle of a scan as a scan of its own, with another size and other pixels."""
    trace, retrace = (scan.values[16:80, 16:80] for scan in pair)
    return trace, retrace, Region((0.0, 0.0), (HOME.size_m[0] * 64 / PIXELS, HOME.size_m[1] * 64 / PIXELS))


def both_kinds(seed: int, condition: str) -> tuple[TipJudge, list[tuple[Scan, Scan]], list[tuple[Scan, Scan]]]:
    """Return a judge with references of whole scans and of their middles, learnt in turns."""
    pairs = channels(seed, condition, 5)
    judge = TipJudge(LEARN)
    for pair in pairs[:LEARN]:
        assert judged(judge, pair).opinion is Opinion.LEARNING
        assert judge.judge(*zoom_of(pair)).opinion is Opinion.LEARNING
    return judge, list(pairs[LEARN:4]), list(pairs[5:9])


@pytest.mark.parametrize("condition", ["double", "contaminated"])
@pytest.mark.parametrize("seed", range(2))
def test_scans_of_two_sizes_are_each_compared_with_their_own_kind(seed: int, condition: str) -> None:
    judge, good, bad = both_kinds(seed, condition)
    judge.restore(json.loads(json.dumps(judge.state())))
    for pair in good:
        assert judged(judge, pair).opinion is Opinion.GOOD
        assert judge.judge(*zoom_of(pair)).opinion is Opinion.GOOD
    for pair in bad:
        assert judge.judge(*zoom_of(pair)).opinion is Opinion.BAD
        assert judged(judge, pair).opinion is Opinion.BAD


def test_new_kind_of_scan_is_not_learnt_while_the_tip_may_be_bad() -> None:
    judge, good, bad = learnt(0, "double")
    assert judged(judge, bad[0]).opinion is Opinion.BAD
    assert judge.judge(*zoom_of(bad[1])).opinion is Opinion.UNCLEAR
    assert judged(judge, good[0]).opinion is Opinion.GOOD
    assert judge.judge(*zoom_of(good[0])).opinion is Opinion.LEARNING
    assert judge.judge(*zoom_of(good[0]), learns=False).opinion is Opinion.UNCLEAR


def test_scans_learnt_between_the_last_good_and_a_bad_one_are_forgotten() -> None:
    judge, good, bad = learnt(0, "double")
    assert judged(judge, good[0]).opinion is Opinion.GOOD
    for pair in bad[:LEARN]:
        assert judge.judge(*zoom_of(pair)).opinion is Opinion.LEARNING
    assert len(judge.kinds) == 2
    assert judged(judge, bad[0]).opinion is Opinion.BAD
    assert len(judge.kinds) == 1


def test_fault_is_not_cleared_by_coarser_scans() -> None:
    judge, good, bad = learnt(0, "double")
    coarse = [(t.values[::2, ::2], r.values[::2, ::2], t.region) for t, r in [*good[:1], *channels(0, "double", 5)[:3]]]
    assert judged(judge, good[0]).opinion is Opinion.GOOD
    for scan in coarse[:LEARN]:
        judge.judge(*scan)
    assert judge.judge(*coarse[LEARN]).opinion is Opinion.GOOD
    assert judged(judge, bad[0]).opinion is Opinion.BAD
    verdict = judge.judge(*coarse[LEARN])
    assert (verdict.opinion, verdict.why) == (Opinion.UNCLEAR, "nothing wrong, but a finer kind of scan showed a fault")
    judge.trust()
    assert judge.judge(*coarse[LEARN]).opinion is Opinion.GOOD


def test_a_scan_with_too_many_holes_is_not_judged() -> None:
    judge, good, _ = learnt(0, "double")
    trace, retrace = good[0]
    holes = trace.values.copy()
    holes[: PIXELS // 2] = np.nan
    assert judge.judge(holes, retrace.values, HOME).opinion is Opinion.UNCLEAR


@pytest.mark.parametrize("every", [False, True], ids=["once", "every time"])
def test_an_overview_before_the_series_does_not_keep_it_from_being_judged(every: bool) -> None:
    pairs = channels(0, "double", 5)
    judge = TipJudge(LEARN)
    overview = np.random.default_rng(1).normal(size=(PIXELS, PIXELS)) * 1e-9
    for number, pair in enumerate(pairs[:LEARN]):
        if every or number == 0:
            judge.judge(overview, None, Region((0.0, 0.0), (1e-5, 1e-5)))
            judge.restore(json.loads(json.dumps(judge.state())))
        assert judged(judge, pair).opinion is Opinion.LEARNING
    assert judged(judge, pairs[3]).opinion is Opinion.GOOD
    assert judged(judge, pairs[5]).opinion is Opinion.BAD


def test_half_a_turn_is_the_same_angle_to_either_side() -> None:
    pairs = channels(0, "double", 5)
    judge = TipJudge(LEARN)
    for pair, angle in zip(pairs[:4], (math.pi, -math.pi, math.pi, -math.pi), strict=True):
        verdict = judge.judge(pair[0].values, pair[1].values, replace(HOME, angle_rad=angle))
    assert verdict.opinion is Opinion.GOOD


def test_a_few_missing_lines_do_no_harm() -> None:
    judge, good, _ = learnt(0, "double")
    trace, retrace = (scan.values.copy() for scan in good[0])
    trace[10:14] = retrace[10:14] = np.nan
    assert judge.judge(trace, retrace, HOME).opinion is not Opinion.BAD


def test_scans_of_different_shape_are_no_pair() -> None:
    with pytest.raises(InvalidValue):
        slopes(np.zeros((64, 64)), np.zeros((64, 63)))


def test_ghost_is_found_at_its_distance() -> None:
    random = np.random.default_rng(3)
    rows, columns = np.mgrid[0:96, 0:120]
    heights = np.zeros((96, 120))
    for y, x in zip(random.integers(5, 90, 40), random.integers(5, 100, 40), strict=True):
        heights = np.maximum(heights, np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / 18.0))
    doubled = np.maximum(heights, np.roll(heights, (0, 15), axis=(0, 1)))
    alone, double = (autocorrelation(slopes(values + 1e-6), 32) for values in (heights, doubled))
    assert ghost(double, alone) > 0.2
    row, column = np.unravel_index(np.argmax((double - alone)[:, 32 + 7 :]), (33, 33 - 7))
    assert (row, column + 7) == (0, 15)


def test_opinions_in_a_row_set_and_clear_a_flag_and_unclear_ones_do_not_count() -> None:
    counter = VerdictCounter(flag_after=2, clear_after=1)
    for opinion in (Opinion.BAD, Opinion.GOOD, Opinion.BAD, Opinion.UNCLEAR):
        counter.count(opinion)
        assert not counter.wants_flag
    counter.count(Opinion.BAD)
    assert counter.wants_flag
    counter.count(Opinion.GOOD)
    assert counter.wants_clear
    assert not counter.wants_flag


@pytest.mark.parametrize("wrong", [{"detail": 1.5}, {"ghost": 0.0}, {"unrest": 1.0}, {"sigmas": -1.0}, {"margin": 0.0}])
def test_invalid_tolerances_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        TipTolerance(**wrong)


def test_single_reference_scan_is_too_few() -> None:
    with pytest.raises(ConfigError):
        TipJudge(1)


# settings: two plans scan one place with another speed each
def test_scans_with_other_settings_have_a_reference_of_their_own() -> None:
    pairs, judge = channels(1, "blunt", 5), TipJudge(LEARN)
    slow, fast = {names.SCAN_SPEED: 2e-6}, {names.SCAN_SPEED: 8e-6}
    opinions = []
    for (trace, retrace), settings in [*((pair, slow) for pair in pairs[:LEARN]), (pairs[5], fast), (pairs[5], slow)]:
        opinions.append(judge.judge(trace.values, retrace.values, trace.region, settings=settings).opinion)
    assert opinions == [Opinion.LEARNING] * (LEARN + 1) + [Opinion.BAD]
    assert judge.knows(HOME, pairs[0][0].shape, slow)
    assert not judge.knows(HOME, pairs[0][0].shape, fast)
