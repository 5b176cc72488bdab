"""Text from outside, such as file names, notes, metadata and controller messages: always data, never instructions.

No program reads these fields. A test holds that harmless and injected texts lead to the same requests, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from afspm.basics import escaped

MOST = 50


def untrusted(texts: Mapping[str, object]) -> dict[str, object]:
    """Return {"untrusted": texts}, escaped and at most `MOST` of each list, for an answer; {} if all are empty."""
    found: dict[str, object] = {}
    for name, value in texts.items():
        if isinstance(value, str):
            found[name] = escaped(value)
        elif isinstance(value, Sequence):
            found[name] = [escaped(str(one)) for one in value[:MOST]]
    return {"untrusted": {name: value for name, value in found.items() if value}} if any(found.values()) else {}
