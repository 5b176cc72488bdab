"""The bill counts lines of code, and what has grown since a commit."""

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

TOOLS = str(Path(__file__).parents[2] / "tools")


@pytest.fixture(scope="module")
def bill() -> Iterator[ModuleType]:
    sys.path.insert(0, TOOLS)
    yield import_module("bill")
    sys.path.remove(TOOLS)


def test_bill_counts_neither_docstrings_nor_comments_nor_blanks(bill: ModuleType) -> None:
    text = '"""One.\n\nTwo."""\n\n# why\nx = 1\n\n\ndef f():\n    """Say."""\n    return x  # so\n'
    assert bill.code_lines(text) == 3


def test_bill_names_the_capability_that_has_grown(bill: ModuleType) -> None:
    before = {"src/afspm/translator/held_z.py": "x = 1\n", "docs/how-to/a.md": "one two"}
    now = {**before, "src/afspm/translator/held_z.py": "x = 1\ny = 2\n", "docs/explanation/decisions/1.md": "three"}

    rows = bill.table(bill.bill(now), bill.bill(before))

    (held_z,) = (row for row in rows if row.startswith("translator: held z"))
    assert held_z.split()[-3:] == ["2", "+1", "0"]
    assert [row.split()[-2:] for row in rows if row.startswith("words: all")] == [["3", "+1"]]
    assert sum("+" in row for row in rows) == 3  # with the folder src
