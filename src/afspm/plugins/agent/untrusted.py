"""Text from outside, such as file names, notes, metadata and controller messages: always data, never instructions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

LONGEST = 200
MOST = 50


def escaped(text: str) -> str:
    """Return a text cut at `LONGEST` characters, with non-printable characters escaped."""
    cut = "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text[:LONGEST])
    return f"{cut}…" if len(text) > LONGEST else cut


def untrusted(texts: Mapping[str, object]) -> dict[str, object]:
    """Return {"untrusted": texts}, escaped and at most `MOST` of each list, for an answer; {} if all are empty."""
    found: dict[str, object] = {}
    for name, value in texts.items():
        if isinstance(value, str):
            found[name] = escaped(value)
        elif isinstance(value, Sequence):
            found[name] = [escaped(str(one)) for one in value[:MOST]]
    return {"untrusted": {name: value for name, value in found.items() if value}} if any(found.values()) else {}
