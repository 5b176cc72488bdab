"""Lua values in Studio's replies are parsed as Lua does."""

from __future__ import annotations

import math
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.plugins.nanosurf.lua_values import BadLua, parse, written

lua54 = pytest.importorskip("lupa.lua54")
LUA = lua54.LuaRuntime()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("{0,{nil}}", {1: 0, 2: {1: None}}),
        ('{1,{"no \\"such\\" thing\\n"}}', {1: 1, 2: {1: 'no "such" thing\n'}}),
        ('{[1]=1,["a b"]=-2.5e-09,c={true,false},}', {1: 1, "a b": -2.5e-9, "c": {1: True, 2: False}}),
        ("0x1F", 31),
        ("'it\\'s \\065'", "it's A"),
        ("{}", {}),
        ("math.huge", math.inf),
    ],
)
def test_values(text: str, value: object) -> None:
    assert parse(text) == value


def test_not_a_number() -> None:
    found = parse("{(0/0)}")
    assert isinstance(found, dict)
    assert math.isnan(found[1])


@pytest.mark.parametrize("text", ["", "{", "{1,", "1 2", "function() end", "{[1}", "x", "\xff\xfe", "{" * 100])
def test_malformed_value_is_refused(text: str) -> None:
    with pytest.raises(BadLua):
        parse(text)


@given(st.text(max_size=200))
def test_any_text_is_a_value_or_refused(text: str) -> None:
    with suppress(BadLua):
        parse(text)


@given(st.one_of(st.booleans(), st.integers(-(2**53), 2**53), st.floats(allow_nan=False, allow_infinity=False)))
def test_lua_reads_written_values(value: float) -> None:
    assert LUA.eval(written(value)) == value


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_lua_reads_written_texts(text: str) -> None:
    assert LUA.eval(written(text)) == text
