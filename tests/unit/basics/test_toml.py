"""TOML from elsewhere is refused with a reason, whatever it holds."""

from __future__ import annotations

import tomllib

import pytest

from afspm.basics.toml import parse_toml

# faults 6
HOSTILE = {
    "lists": ("a = " + "[" * 60_000 + "]" * 60_000, "nested more than 50 deep"),
    "few lists, which the parser still reads": ("a = " + "[" * 60 + "]" * 60, "nested more than 50 deep"),
    "tables": ("a = " + "{b = " * 20_000 + "1" + "}" * 20_000, "nested more than 50 deep"),
    "a dotted header": ("[" + ".".join("a" * 2_000) + "]", "nested more than 50 deep"),
    "an integer": ("a = " + "9" * 200_000, "an integer has too many digits"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_document_is_refused_with_a_reason(case: str) -> None:
    text, reason = HOSTILE[case]
    with pytest.raises(tomllib.TOMLDecodeError, match=reason):
        parse_toml(text)


def test_document_of_usual_depth_is_read() -> None:
    assert parse_toml("[a.b]\nc = [[1, 2], [3]]\nd = { e = [{ f = 4 }] }") == {
        "a": {"b": {"c": [[1, 2], [3]], "d": {"e": [{"f": 4}]}}}
    }
