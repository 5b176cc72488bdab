"""JSON that another program or person wrote."""

from __future__ import annotations

import pytest

from afspm.basics.plain_data import from_json


@pytest.mark.parametrize("text", ["[" * 200_000, '{"a":' * 200_000, "{", "nothing"])
def test_nested_or_broken_json_is_a_value_error(text: str) -> None:
    for written in (text, text.encode()):
        with pytest.raises(ValueError, match=r"nested too deeply|Expecting"):
            from_json(written)


def test_json_is_read_as_json_reads_it() -> None:
    assert from_json(b'{"a": [1, 2.5, null, true]}') == {"a": [1, 2.5, None, True]}
