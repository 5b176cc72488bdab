"""The line of each key, in every notation of TOML."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.experiment.toml_lines import Path, locate
from afspm.experiment.toml_writer import dumps

TEXT = '''\
# a comment with [brackets] and = signs
plain = "text # no comment"
dotted.key.deep = 1
"quoted key" = 'single'
"with.dot" = 3

[table]
array = [
  1,
  # between
  "two, ]",
  [3, 4],
]
inline = { a = 1, b = { c = "}" } }
text = """
[not.a.table]
key = 1 \\""" still
"""
literal = \'\'\'
[neither]
\'\'\'
date = 2026-01-01T00:00:00Z  # after

[table.sub."strange name"]
x = 1

[[many]]
name = "first"

[[many]]
name = "second"

[many.below]
y = 2

[[many.inner]]
z = 1
[[many.inner]]
z = 2
'''


@pytest.mark.parametrize(
    ("path", "start"),
    [
        (("plain",), "plain"),
        (("dotted", "key", "deep"), "dotted"),
        (("quoted key",), '"quoted'),
        (("with.dot",), '"with.dot'),
        (("table",), "[table]"),
        (("table", "array"), "array"),
        (("table", "array", 0), "  1,"),
        (("table", "array", 1), '  "two'),
        (("table", "array", 2, 1), "  [3"),
        (("table", "inline", "b", "c"), "inline"),
        (("table", "text"), "text"),
        (("table", "literal"), "literal"),
        (("table", "date"), "date"),
        (("table", "sub", "strange name"), "[table.sub"),
        (("many", 0, "name"), 'name = "first"'),
        (("many", 1, "name"), 'name = "second"'),
        (("many", 1, "below", "y"), "y = 2"),
        (("many", 1, "inner", 0, "z"), "z = 1"),
        (("many", 1, "inner", 1, "z"), "z = 2"),
    ],
)
def test_each_key_is_found_on_its_line(path: Path, start: str) -> None:
    tomllib.loads(TEXT)  # the text is valid, or this test says nothing
    line = TEXT.splitlines()[locate(TEXT)[path] - 1]
    assert line.startswith(start)


def test_nothing_within_texts_is_taken_for_a_key() -> None:
    found = locate(TEXT)
    assert ("not",) not in found
    assert ("neither",) not in found
    assert ("table", "key") not in found


def test_windows_line_ends_count_once() -> None:
    assert locate("a = 1\r\nb = 2\r\n")[("b",)] == 2


KEYS = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=8)
SCALARS = st.one_of(
    st.integers(-(2**60), 2**60), st.booleans(), st.floats(allow_nan=False, allow_infinity=False), st.text(max_size=10)
)
VALUES = st.recursive(SCALARS, lambda v: st.lists(v, max_size=3) | st.dictionaries(KEYS, v, max_size=3), max_leaves=8)
DOCUMENTS = st.dictionaries(KEYS, SCALARS | st.dictionaries(KEYS, VALUES, max_size=4), max_size=5)


@given(DOCUMENTS)
def test_every_path_of_any_document_has_a_line(document: dict[str, Any]) -> None:
    text = dumps(document)
    assert set(locate(text)) == set(_paths(tomllib.loads(text)))


@given(DOCUMENTS)
def test_written_toml_round_trips(document: dict[str, Any]) -> None:
    assert tomllib.loads(dumps(document)) == document


def _paths(value: Any, path: Path = ()) -> list[Path]:
    here = [path] if path else []
    if isinstance(value, dict):
        return here + [p for key, item in value.items() for p in _paths(item, (*path, key))]
    if isinstance(value, list):
        return here + [p for i, item in enumerate(value) for p in _paths(item, (*path, i))]
    return here
