"""What repairs learn, the file that keeps it, and the budget of a night."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from afspm.basics.errors import ConfigError, FileError
from afspm.components.tip_budget import RepairBudget, RepairCost, cost_of
from afspm.components.tip_experience import (
    CURED,
    MOST_COUNTED,
    MOST_OF_PAST_NIGHTS,
    UNCHANGED,
    WORSENED,
    OutcomeCounts,
    TipExperience,
)
from afspm.components.tip_experience_file import experience_text, read_experience, write_experience
from afspm.components.tip_treatments import Crash, Pulse, treatments
from afspm.model.snapshot import from_plain, to_plain

ALLOWED = treatments((3.0, -4.0), 50e-3, (5e-9,), 50e-9)
PLUS, MINUS, DEEP = ALLOWED


def experienced(*outcomes: tuple[str, Pulse | Crash, str, int]) -> TipExperience:
    experience = TipExperience()
    for flaw, treatment, outcome, times in outcomes:
        for _ in range(times):
            experience.learn(flaw, treatment, outcome)
    return experience


def chosen(experience: TipExperience, flaw: str, draws: int = 200) -> list[Pulse | Crash]:
    found = []
    for number in range(draws):
        experience.outcomes = number
        found.append(experience.choose(flaw, ALLOWED))
    return found


def test_treatment_that_cured_is_chosen_nearly_always_and_for_its_flaw_only() -> None:
    experience = experienced(
        ("double", MINUS, CURED, 6), ("double", PLUS, UNCHANGED, 4), ("double", DEEP, UNCHANGED, 4)
    )
    assert chosen(experience, "double").count(MINUS) > 190
    of_other = chosen(experience, "blunt")
    assert min(of_other.count(one) for one in ALLOWED) > 20


def test_treatment_that_worsens_is_avoided_among_equally_good_ones() -> None:
    experience = experienced()
    experience.counts["double"] = {
        str(PLUS): OutcomeCounts(cured=4.0, unchanged=6.0),
        str(MINUS): OutcomeCounts(cured=4.0, worsened=6.0),
        str(DEEP): OutcomeCounts(unchanged=10.0),
    }
    found = chosen(experience, "double")
    assert found.count(PLUS) > 4 * found.count(MINUS)


def test_choice_is_the_same_after_a_restart() -> None:
    experience = experienced(("double", MINUS, CURED, 1))
    again = from_plain(TipExperience, to_plain(experience))
    assert again == experience
    assert [again.choose("double", ALLOWED) for _ in range(3)] == [experience.choose("double", ALLOWED)] * 3


def test_only_an_allowed_treatment_is_chosen() -> None:
    experience = experienced(("double", MINUS, CURED, 6))
    assert experience.choose("double", (PLUS,)) == PLUS


def test_old_outcomes_fade_and_nights_count_less() -> None:
    experience = experienced(("double", MINUS, CURED, 50))
    assert experience.of("double", MINUS).total == pytest.approx(MOST_COUNTED)
    following = experience.for_next_night()
    assert following.of("double", MINUS).total == pytest.approx(MOST_OF_PAST_NIGHTS)
    assert (following.nights, following.outcomes) == (1, 0)
    assert experience.of("double", MINUS).total == pytest.approx(MOST_COUNTED)


def test_improbable_run_of_failures_weakens_the_experience_of_its_flaw_alone() -> None:
    experience = experienced(("double", MINUS, CURED, 8), ("blunt", DEEP, CURED, 8))
    surprises = [experience.learn("double", MINUS, UNCHANGED) for _ in range(3)]
    assert True in surprises
    assert experience.of("double", MINUS).total < 4.0
    assert experience.of("blunt", DEEP).total == 8.0


def test_failures_of_a_treatment_that_rarely_cures_are_no_surprise() -> None:
    experience = experienced(("double", MINUS, WORSENED, 5))
    assert not any(experience.learn("double", MINUS, UNCHANGED) for _ in range(10))


def test_experience_survives_its_file(tmp_path: Path) -> None:
    experience = experienced(("double", MINUS, CURED, 3), ("double", DEEP, WORSENED, 1), ("blunt", DEEP, UNCHANGED, 2))
    experience.nights = 4
    path = tmp_path / "new" / "experience.toml"
    write_experience(path, experience)
    found = read_experience(path)
    assert (found.nights, found.counts) == (4, experience.counts)
    assert '"pulse of -4 V, 50 ms" = { cured = 3, worsened = 0, unchanged = 0 }' in path.read_text(encoding="utf-8")
    assert experience_text(found) == path.read_text(encoding="utf-8")


def test_missing_file_is_no_experience(tmp_path: Path) -> None:
    assert read_experience(tmp_path / "none.toml") == TipExperience()


@pytest.mark.parametrize(
    "text",
    [
        "[double",
        "nights = -1",
        "nights = true",
        "double = 3",
        '[double]\n"pulse" = 3',
        '[double]\n"pulse" = { cured = -1 }',
        '[double]\n"pulse" = { cured = nan }',
        '[double]\n"pulse" = { healed = 1 }',
        '[double]\n"pulse" = { cured = true }',
    ],
)
def test_file_with_other_content_is_refused_with_its_place(text: str, tmp_path: Path) -> None:
    path = tmp_path / "experience.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileError, match=r"experience\.toml"):
        read_experience(path)


def test_budget_allows_what_fits_into_each_bound() -> None:
    budget = RepairBudget(pulses=2, depth_m=12e-9, area_m2=5 * 1e-14, time_s=600.0)
    spent = RepairCost()
    assert budget.affordable(ALLOWED, spent, 100e-9, 60.0) == ALLOWED
    for _ in range(2):
        spent = spent.plus(cost_of(PLUS, 100e-9)).after(50.0)
    assert budget.affordable(ALLOWED, spent, 100e-9, 60.0) == (DEEP,)
    for _ in range(2):
        spent = spent.plus(cost_of(DEEP, 100e-9)).after(50.0)
    assert budget.affordable(ALLOWED, spent, 100e-9, 60.0) == ()
    assert budget.exceeded_by(spent.plus(cost_of(DEEP, 100e-9))) == ("depth_m",)
    assert budget.affordable(ALLOWED, RepairCost(time_s=541.0), 100e-9, 60.0) == ()
    assert budget.affordable(ALLOWED, RepairCost(area_m2=4.5e-14), 100e-9, 60.0) == ()


def test_equal_parts_fill_a_budget_in_spite_of_rounding() -> None:
    spent, budget = RepairCost(), RepairBudget(depth_m=30 * 0.1e-9)
    tenth = Crash(0.1e-9, 50e-9)
    for _ in range(30):
        assert budget.affordable((tenth,), spent, 1e-7, 0.0)
        spent = spent.plus(cost_of(tenth, 1e-7))
    assert not budget.affordable((tenth,), spent, 1e-7, 0.0)


def test_negative_budget_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^night_pulses: a budget can't be negative"):
        RepairBudget(pulses=-1, time_s=-1.0)


def test_no_draw_exceeds_a_budget() -> None:
    draw = random.Random(3)
    for _ in range(300):
        budget = RepairBudget(draw.randint(0, 6), draw.uniform(0, 60e-9), draw.uniform(0, 1e-12), draw.uniform(0, 3e3))
        spent, experience = RepairCost(), TipExperience(draw.randint(0, 9))
        while affordable := budget.affordable(ALLOWED, spent, 300e-9, 60.0):
            one = experience.choose("double", affordable)
            spent = spent.plus(cost_of(one, 300e-9)).after(draw.uniform(0.0, 60.0))
            experience.learn("double", one, draw.choice([CURED, WORSENED, UNCHANGED]))
            assert budget.exceeded_by(spent) == ()
