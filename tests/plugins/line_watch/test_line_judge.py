"""The judge of running scans, over simulated scans line by line."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from scipy import ndimage, signal
from tests.plugins.line_watch.line_scans_lab import (
    CHANGED_ROW,
    CHANNELS,
    HOME,
    LEARNT,
    PERIOD_S,
    ROWS,
    Picture,
    night,
    steps,
)

from afspm.model import Region
from afspm.plugins.line_watch.line_judge import Alarm, AlarmLevel, Kind, LineJudge, LineStatistic, PairStatistics
from afspm.plugins.line_watch.registration import RowTemplate

Heights = list[np.ndarray[tuple[int, int], np.dtype[np.float64]]]
KIND = Kind.of(HOME, (ROWS, ROWS), "")
USUAL_M = 3.3e-10 / np.sqrt(2.0)
"""The noise of one scan: the judge finds 0.33 nm in the difference of two, with and without the retrace."""


def heights(picture: Picture) -> Heights:
    return [picture[channel].copy() for channel in CHANNELS]


def taught(pictures: Sequence[Picture] | None = None) -> LineJudge:
    return copy.deepcopy(_usual()) if pictures is None else _taught(pictures)


@cache
def _usual() -> LineJudge:
    return _taught(night())


def _taught(pictures: Sequence[Picture]) -> LineJudge:
    judge = LineJudge()
    for number, picture in enumerate(pictures[:LEARNT]):
        judge.learn(heights(picture), HOME, KIND, number * PERIOD_S)
    return judge


def stopped(judge: LineJudge, picture: Heights, at_s: float = LEARNT * PERIOD_S) -> Alarm | None:
    """Return the alarm that stops a scan from the first row to the last."""
    running = judge.begin(HOME, KIND, at_s, channels=2)
    assert running is not None
    for row in range(ROWS):
        alarm = running.add(row, [values[row] for values in picture])
        if alarm is not None and alarm.level is AlarmLevel.STOP:
            return alarm
    return None


@pytest.mark.parametrize("flaw", ["double", "blunt", "contaminated"])
def test_changed_tip_stops_the_scan_within_twenty_rows(flaw: str) -> None:
    pictures = night(flaw)
    alarm = stopped(taught(pictures), heights(pictures[-1]))
    assert alarm is not None
    assert CHANGED_ROW <= alarm.row <= CHANGED_ROW + 20
    assert abs(alarm.since_row - CHANGED_ROW) <= 5
    assert alarm.evidence >= 1.0


def test_good_scan_on_a_drifting_sample_is_not_stopped() -> None:
    assert stopped(taught(), heights(night()[LEARNT])) is None


def test_first_scans_of_a_kind_are_not_judged() -> None:
    judge = LineJudge()
    for number in range(LEARNT):
        assert judge.begin(HOME, KIND, number * PERIOD_S, channels=2) is None
        judge.learn(heights(night()[number]), HOME, KIND, number * PERIOD_S)
    assert judge.begin(HOME, KIND, LEARNT * PERIOD_S, channels=2) is not None


def test_scan_at_another_setpoint_is_another_kind() -> None:
    other = Kind.of(HOME, (ROWS, ROWS), "0.5")
    assert taught().begin(HOME, other, LEARNT * PERIOD_S, channels=2) is None


def test_more_noise_with_the_same_image_is_reported_as_noise() -> None:
    random = np.random.default_rng(3)
    noisy = [values + 1.5 * USUAL_M * random.standard_normal(values.shape) for values in heights(night()[LEARNT])]
    running = taught().begin(HOME, KIND, LEARNT * PERIOD_S, channels=2)
    assert running is not None
    for row in range(ROWS):
        assert running.add(row, [values[row] for values in noisy]) is None
    assert running.noise > 1.25
    quiet = taught().begin(HOME, KIND, LEARNT * PERIOD_S, channels=2)
    assert quiet is not None
    for row in range(ROWS):
        quiet.add(row, [values[row] for values in heights(night()[LEARNT])])
    assert quiet.noise < 1.1


@pytest.mark.parametrize("period_px", [7.3, 18.0, 45.0])
def test_hum_is_no_change(period_px: float) -> None:
    time = 2.0 * ROWS * np.arange(ROWS)[:, None] + np.arange(ROWS)
    humming = [
        values + 2.0 * USUAL_M * np.sin(2.0 * np.pi * at / period_px)
        for values, at in zip(heights(night()[LEARNT]), (time, time[:, ::-1] + ROWS), strict=True)
    ]
    assert stopped(taught(), humming) is None


def taught_without_retrace() -> LineJudge:
    judge = LineJudge()
    for number, picture in enumerate(night()[:LEARNT]):
        judge.learn(heights(picture)[:1], HOME, KIND, number * PERIOD_S)
    return judge


def alarms_without_retrace(judge: LineJudge, picture: Picture, at_s: float, hum: float) -> tuple[list[Alarm], float]:
    """Return the alarms of a trace with a hum that is in step in all rows, and the noise at its end."""
    heights_m = heights(picture)[0]
    heights_m += hum * USUAL_M * np.sin(2.0 * np.pi * np.arange(ROWS) * 11.0 / 128.0)
    running = judge.begin(HOME, KIND, at_s, channels=1)
    assert running is not None
    found = [alarm for row in range(ROWS) if (alarm := running.add(row, [heights_m[row]])) is not None]
    judge.learn([heights_m], HOME, KIND, at_s)
    return found, running.noise


def test_hum_in_step_in_all_rows_is_noise_without_retrace() -> None:
    judge, good = taught_without_retrace(), night()[LEARNT]
    alarms, noise = alarms_without_retrace(judge, good, LEARNT * PERIOD_S, hum=3.0)
    assert not alarms
    assert noise > 1.25
    alarms, _ = alarms_without_retrace(judge, good, LEARNT * PERIOD_S + 1.0, hum=0.0)
    assert not alarms, "the hum of the reference is no change of the tip, either"


def test_changed_tip_stops_a_humming_scan_without_retrace() -> None:
    alarms, _ = alarms_without_retrace(taught_without_retrace(), night()[-1], LEARNT * PERIOD_S, hum=3.0)
    assert alarms[-1].level is AlarmLevel.STOP
    assert CHANGED_ROW <= alarms[0].row <= alarms[-1].row <= CHANGED_ROW + 20


def adorned(picture: Heights, at: tuple[int, int]) -> Heights:
    """Return a scan with a round adsorbate."""
    y, x = np.mgrid[0:ROWS, 0:ROWS]
    return [values + 30e-9 * np.exp(-((x - at[1]) ** 2 + (y - at[0]) ** 2) / 1.5**2) for values in picture]


def test_adsorbate_is_looked_at_and_never_stopped_for() -> None:
    running = taught().begin(HOME, KIND, LEARNT * PERIOD_S, channels=2)
    assert running is not None
    picture = adorned(heights(night()[LEARNT]), (35, 20))
    levels = [
        alarm.level
        for row in range(ROWS)
        if (alarm := running.add(row, [values[row] for values in picture])) is not None
    ]
    assert levels == [AlarmLevel.LOOK]


# tip T4
@pytest.mark.parametrize("number", [3, 5])
def test_several_new_adsorbates_are_looked_at_and_never_stopped_for(number: int) -> None:
    running = taught().begin(HOME, KIND, LEARNT * PERIOD_S, channels=2)
    assert running is not None
    picture = heights(night()[LEARNT])
    for at in [(20, 12), (24, 50), (29, 31), (35, 20), (41, 44)][:number]:
        picture = adorned(picture, at)
    lines = ([values[row] for values in picture] for row in range(ROWS))
    levels = [alarm.level for row, line in enumerate(lines) if (alarm := running.add(row, line)) is not None]
    assert levels == [AlarmLevel.LOOK]


def test_zero_rows_are_missing_rows() -> None:
    picture = heights(night()[LEARNT])
    for values in picture:
        values[[14, 15, 16, 17, 30, 31, 45]] = 0.0
    running = taught().begin(HOME, KIND, LEARNT * PERIOD_S, channels=2)
    assert running is not None
    assert all(running.add(row, [values[row] for values in picture]) is None for row in range(ROWS))
    assert not {14, 15, 16, 17, 30, 31, 45} & set(running.fitted)


def test_missing_rows_are_no_change() -> None:
    picture = heights(night()[LEARNT])
    for values in picture:
        values[[20, 21, 40]] = np.nan
        values[33, :10] = np.nan
    assert stopped(taught(), picture) is None


def test_scar_in_one_row_is_no_change() -> None:
    picture = heights(night()[LEARNT])
    for values in picture:
        values[25, 10:50] += 20e-9
    assert stopped(taught(), picture) is None


def test_scan_with_spikes_is_a_measure_of_the_next_one() -> None:
    judge, spiky = taught(), heights(night()[LEARNT])
    for values in spiky:
        values[[12, 13, 14, 15, 40], [9, 30, 17, 44, 50]] += 60e-9
    assert stopped(judge, spiky) is None
    judge.learn(spiky, HOME, KIND, LEARNT * PERIOD_S)
    moved = [np.roll(values, (1, 1), axis=(0, 1)) for values in heights(night()[LEARNT])]
    assert stopped(judge, moved, LEARNT * PERIOD_S + 1.0) is None


def test_sample_that_jumps_is_registered_again() -> None:
    picture = heights(night()[LEARNT])
    for values in picture:
        values[30:] = np.roll(values, (-4, 6), axis=(0, 1))[30:]
        values[-4:] = np.nan
    assert stopped(taught(), picture) is None


@pytest.mark.parametrize("jump", [(-4, 6), (9, -12)])
def test_sample_that_jumps_along_flat_steps_is_registered_again(jump: tuple[int, int]) -> None:
    # edges almost parallel to the rows: the slopes of a row hardly show its place
    pictures = steps(jump)
    assert stopped(taught(pictures), heights(pictures[LEARNT])) is None


def test_scan_with_a_jump_is_a_measure_of_the_next_one() -> None:
    pictures = steps((-4, 6))
    judge = taught(pictures)
    judge.learn(heights(pictures[LEARNT]), HOME, KIND, LEARNT * PERIOD_S)
    running = judge.begin(HOME, KIND, (LEARNT + 1) * PERIOD_S, channels=2)
    assert running is not None
    assert running.threshold == 20.0, "of the rows at the jump two are a measure, the rest is registered again"
    assert stopped(judge, heights(pictures[-1]), (LEARNT + 1) * PERIOD_S) is None


def test_scan_after_a_jump_is_compared_with_the_scan_before_it() -> None:
    # the two halves of a scan with a jump don't fit together
    judge, whole = taught(), heights(night()[LEARNT])
    slipped = [np.roll(values, (-3, 4), axis=(0, 1)) for values in whole]
    jumped = [np.concatenate([before[:30], after[30:]]) for before, after in zip(whole, slipped, strict=True)]
    assert stopped(judge, jumped) is None
    judge.learn(jumped, HOME, KIND, LEARNT * PERIOD_S)
    running = judge.begin(HOME, KIND, (LEARNT + 1) * PERIOD_S, channels=2)
    assert running is not None
    evidence = 0.0
    for row in range(ROWS - 4):
        assert running.add(row, [values[row] for values in slipped]) is None
        evidence = max(evidence, running.evidence)
    assert evidence < 0.3


def test_missing_rows_of_a_reference_are_interpolated() -> None:
    rows, columns = np.mgrid[0:16, 0:12].astype(np.float64)
    holed = np.sin(0.6 * columns) * rows
    holed[[0, 5, 6]] = np.nan
    template = RowTemplate.of(holed, doubtful=[10])
    assert set(np.flatnonzero(~template.trusted)) == {0, 5, 6, 10}
    assert np.isfinite(template.heights).all()
    for at, low, high in ((5, 4, 7), (6, 4, 7), (10, 9, 11)):
        share = (at - low) / (high - low)
        between = (1.0 - share) * template.heights[low] + share * template.heights[high]
        np.testing.assert_allclose(template.heights[at], between, atol=1e-12)
    np.testing.assert_array_equal(template.heights[0], template.heights[1])


def pair_of(size: float) -> PairStatistics:
    return PairStatistics(flat_m=size, per_slope=0.1, usual=0.1, spread=0.1, highest=20.0 * size, noise=1.0)


def test_few_pairs_are_judged_by_the_least_alike_one() -> None:
    alike, unlike = pair_of(1.0), pair_of(2.0)
    assert LineStatistic([alike, alike, unlike]).flat_m == 2.0
    assert LineStatistic([alike, alike, alike, unlike]).flat_m == 1.0


def test_pair_of_scans_with_a_change_between_them_is_no_measure_of_good_scans() -> None:
    for pairs in ([pair_of(1.0), pair_of(3.0)], [pair_of(3.0), pair_of(1.0), pair_of(1.0)]):
        statistic = LineStatistic(pairs)
        assert (statistic.flat_m, statistic.threshold) == (1.0, 40.0)


def test_scan_unlike_the_earlier_ones_all_along_keeps_the_threshold_within_reach() -> None:
    random, pictures = np.random.default_rng(8), [heights(picture) for picture in night()[:LEARNT]]
    common = USUAL_M * random.standard_normal(pictures[0][0].shape)
    judge = LineJudge()
    for number, picture in enumerate(pictures):
        unlike = [values + common * (number == LEARNT - 1) for values in picture]
        judge.learn(unlike, HOME, KIND, number * PERIOD_S)
    running = judge.begin(HOME, KIND, LEARNT * PERIOD_S, channels=2)
    assert running is not None
    assert running.threshold < 100.0, "twenty lines reach no more"


def test_tip_that_spoils_some_lines_is_no_jump() -> None:
    spoilt = heights(night()[LEARNT])
    for values in spoilt:
        values[30:60:3] += 20e-9 * np.random.default_rng(1).standard_normal(values[30:60:3].shape)
    alarm = stopped(taught(), spoilt)
    assert alarm is not None
    assert alarm.row <= 60


def test_rows_from_the_last_to_the_first_are_judged_alike() -> None:
    pictures = night("double", "down")
    judge = LineJudge()
    for number, picture in enumerate(pictures[:LEARNT]):
        judge.learn(heights(picture), HOME, KIND, number * PERIOD_S, downwards=True)
    running = judge.begin(HOME, KIND, LEARNT * PERIOD_S, channels=2)
    assert running is not None
    alarms = [running.add(row, [v[row] for v in heights(pictures[-1])]) for row in reversed(range(ROWS))]
    row = next(alarm.row for alarm in alarms if alarm is not None and alarm.level is AlarmLevel.STOP)
    assert ROWS - 1 - CHANGED_ROW - 20 <= row <= ROWS - 1 - CHANGED_ROW


def test_scan_of_a_new_place_is_not_judged() -> None:
    elsewhere = Region((3e-6, 0.0), HOME.size_m)
    assert taught().begin(elsewhere, KIND, LEARNT * PERIOD_S, channels=2) is None


def test_state_that_was_saved_judges_alike() -> None:
    judge, again = taught(), LineJudge()
    again.restore(judge.state())
    again.learn(heights(night()[LEARNT - 1]), HOME, KIND, (LEARNT - 1) * PERIOD_S, again=True)
    found = stopped(again, heights(night()[-1]))
    assert found is not None
    assert found.row >= CHANGED_ROW


def test_rests_of_stopped_scans_do_not_displace_a_known_kind() -> None:
    judge = taught()
    for rows in range(20, 28):
        rest = Kind.of(HOME, (rows, ROWS), "")
        judge.learn([values[:rows] for values in heights(night()[0])], HOME, rest, 500.0)
    assert judge.pairs(KIND) == LEARNT - 1


def looks(picture: Heights, channels: int = 2) -> list[Alarm]:
    """Return all alarms of the scan after the first ones, with or without its retrace."""
    judge = taught() if channels == 2 else taught_without_retrace()
    running = judge.begin(HOME, KIND, LEARNT * PERIOD_S, channels=channels)
    assert running is not None
    rows = (running.add(row, [values[row] for values in picture[:channels]]) for row in range(ROWS))
    return [alarm for alarm in rows if alarm is not None]


@pytest.mark.parametrize("channels", [1, 2])
def test_three_times_the_noise_is_looked_at_within_twenty_rows(channels: int) -> None:
    random = np.random.default_rng(4)
    noisy = heights(night()[LEARNT])
    for values in noisy:
        values[CHANGED_ROW:] += math.sqrt(8.0) * USUAL_M * random.standard_normal(values[CHANGED_ROW:].shape)
    (alarm,) = looks(noisy, channels)
    assert alarm.level is AlarmLevel.LOOK
    assert CHANGED_ROW - 2 <= alarm.since_row < alarm.row <= CHANGED_ROW + 20
    assert "the noise is" in alarm.why


@pytest.mark.parametrize(("longest", "channels"), [(20, 1), (20, 2), (45, 2)])
def test_streaks_are_looked_at_within_twenty_rows(longest: int, channels: int) -> None:
    random = np.random.default_rng(5)
    streaked = heights(night()[LEARNT])
    for values in streaked:
        for row in CHANGED_ROW + np.nonzero(random.random(ROWS - CHANGED_ROW) < 0.6)[0]:
            first = int(random.integers(ROWS - 10))
            values[row, first : first + int(random.integers(longest - 12, longest))] += 15.0 * USUAL_M
    (alarm,) = looks(streaked, channels)
    assert alarm.level is AlarmLevel.LOOK
    assert CHANGED_ROW <= alarm.row <= CHANGED_ROW + 20
    assert "streaks" in alarm.why or channels == 1, "without retrace, strong streaks look like noise"


def overshooting(values: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> np.ndarray:
    """Return lines as of a feedback of second order with little damping."""
    pole = 0.75 * np.exp(0.7j)
    below = [1.0, -2.0 * pole.real, abs(pole) ** 2]
    start = signal.lfilter_zi([sum(below)], below) * values[:, :1]
    return np.asarray(signal.lfilter([sum(below)], below, values, axis=1, zi=start)[0])


@pytest.mark.parametrize("cause", ["contrast", "range", "overshoots"])
def test_change_that_is_a_function_of_height_or_follows_edges_is_looked_at(cause: str) -> None:
    trace, retrace = heights(night()[LEARNT])
    if cause == "contrast":
        trace, retrace = 1.05 * trace, 1.05 * retrace
    elif cause == "range":
        trace, retrace = (np.minimum(values, np.quantile(values, 0.93)) for values in (trace, retrace))
    else:
        trace, retrace = overshooting(trace), overshooting(retrace[:, ::-1])[:, ::-1]
    (alarm,) = looks([trace, retrace])
    assert alarm.level is AlarmLevel.LOOK
    # what overshoots on few features looks like noise first: trace and retrace differ
    assert cause in alarm.why or cause == "overshoots"


@pytest.mark.parametrize("long", [5, 7])
def test_debris_that_smears_the_image_is_no_overshoot(long: int) -> None:
    random = np.random.default_rng(8)
    scan = ndimage.gaussian_filter(random.standard_normal((ROWS, ROWS)), 2.0)
    scans = [
        {name: 6e-9 * scan + 1e-10 * random.standard_normal(scan.shape) for name in CHANNELS} for _ in range(LEARNT + 1)
    ]
    smeared = heights(scans[LEARNT])
    for values in smeared:
        values[CHANGED_ROW:] = ndimage.uniform_filter1d(values[CHANGED_ROW:], long, axis=1)
    alarm = stopped(taught(scans), smeared)
    assert alarm is not None
    assert CHANGED_ROW <= alarm.row <= CHANGED_ROW + 20


def test_large_change_of_the_contrast_within_a_scan_is_the_tip() -> None:
    changed = heights(night()[LEARNT])
    for values in changed:
        values[CHANGED_ROW:] *= 1.3
    assert looks(changed)[-1].level is AlarmLevel.STOP


def test_large_change_of_the_contrast_of_lamellae_is_no_overshoot() -> None:
    random, phase = np.random.default_rng(6), np.add.outer(0.2 * np.arange(ROWS), 0.7 * np.arange(ROWS))
    scans = [
        {name: 2e-9 * np.sin(phase) + 1e-10 * random.standard_normal(phase.shape) for name in CHANNELS}
        for _ in range(LEARNT + 1)
    ]
    changed = heights(scans[LEARNT])
    for values in changed:
        values[CHANGED_ROW:] *= 0.65
    alarm = stopped(taught(scans), changed)
    assert alarm is not None
    assert CHANGED_ROW <= alarm.row <= CHANGED_ROW + 20
