"""Each commit tries a part of the large sets of tests, and no test is left out for ever."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from rotation import IN_TURN, in_turn

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(("file", "parts"), IN_TURN.items())
def test_test_in_turn_is_tried_once_in_as_many_commits(file: str, parts: int) -> None:
    assert (ROOT / file).exists()
    tests = [f"{file}::test_it[{number}]" for number in range(2 * parts + 1)]
    tried = [in_turn(tests, commit) for commit in range(parts)]
    assert Counter(test for some in tried for test in some) == Counter(tests)
    assert {len(some) for some in tried} == {2, 3}


def test_test_of_another_file_is_tried_at_each_commit() -> None:
    assert in_turn(["tests/docs/test_snippets.py::test_it"], 7) == {"tests/docs/test_snippets.py::test_it"}
