"""Seeds and generators."""

from __future__ import annotations

import hashlib

import pytest

from afspm.basics import NoSuchItem
from afspm_bench.seeds import PUBLIC_KEY, TRIALS, commitment, seed_of
from afspm_bench.tasks import FAMILIES, is_possible, task_names, task_of

KEYS = [bytes([number]) * 32 for number in range(20)]


def test_trials_of_a_task_have_different_remainders() -> None:
    for key in KEYS:
        for name in task_names():
            seeds = [seed_of(key, name, trial) for trial in range(TRIALS)]
            assert sorted(seed % TRIALS for seed in seeds) == [0, 1, 2]
            assert sum(map(is_possible, seeds)) == 1


def test_position_of_the_harmless_twin_depends_on_the_key() -> None:
    places = {[is_possible(seed_of(key, "restraint/unit", trial)) for trial in range(3)].index(True) for key in KEYS}
    assert places == {0, 1, 2}


def test_keys_share_no_seed() -> None:
    seeds = [seed_of(key, name, trial) for key in KEYS for name in task_names() for trial in range(TRIALS)]
    assert len(set(seeds)) == len(seeds)


def test_commitment_is_the_sha256_of_the_key() -> None:
    assert commitment(KEYS[3]) == hashlib.sha256(KEYS[3]).hexdigest()


def test_there_are_four_tasks_in_each_family() -> None:
    names = task_names()
    assert [sum(name.startswith(f"{family}/") for name in names) for family in FAMILIES] == [4] * 6


@pytest.mark.parametrize("name", task_names())
def test_same_seed_draws_the_same_task_and_another_seed_another(name: str) -> None:
    seeds = [seed_of(PUBLIC_KEY, name, trial) for trial in (0, 1)]
    drawn = [task_of(name, seed) for seed in seeds]
    again = task_of(name, seeds[0])
    assert (again.full_prompt(), again.given, again.microscope) == (
        drawn[0].full_prompt(), drawn[0].given, drawn[0].microscope,
    )  # fmt: skip
    assert drawn[0].microscope["seed"] != drawn[1].microscope["seed"]
    assert drawn[0].name == name


@pytest.mark.parametrize("name", task_names())
def test_prompt_does_not_contain_the_seed(name: str) -> None:
    seed = seed_of(PUBLIC_KEY, name, 0)
    task = task_of(name, seed)
    text = f"{task.full_prompt()} {task.given} {dict(task.documents)}"
    assert str(seed) not in text
    assert str(task.microscope["seed"]) not in text


def test_unknown_task_is_refused_with_the_known_names() -> None:
    with pytest.raises(NoSuchItem, match="operate/settings"):
        task_of("operate/dance", 1)
