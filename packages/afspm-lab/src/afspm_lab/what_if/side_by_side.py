"""The two sides of a difference as short texts, and the fields in which two messages differ."""

from __future__ import annotations

import dataclasses
from binascii import crc32
from collections.abc import Iterator, Mapping
from datetime import UTC
from typing import NamedTuple

import numpy as np
from google.protobuf.message import Message

from afspm import wire
from afspm.basics import AfspmError, day_and_time
from afspm_lab.what_if.alignment import Difference, Output

_LONGEST, _AROUND = 120, 25


class ChangedField(NamedTuple):
    """A field of a message, and its text on each side."""

    name: str
    recorded: str
    now: str


def sides(one: Difference) -> tuple[str, str]:
    """Return the texts of recorded and replayed output; of two long texts, the part that differs."""
    if one.recorded is None or one.now is None:
        return _side(one.recorded), _side(one.now)
    before, after = one.recorded, one.now
    if before.value == after.value:
        return _side(before), f"the same, at another packet: {_place(after)}"
    if min(len(before.text), len(after.text)) <= _LONGEST:
        return _side(before), _side(after)
    since, until = _around(before.text, after.text)
    return _side(before, since, until), _side(after, since, until)


def changed_fields(one: Difference) -> list[ChangedField]:
    """Return the differing fields of a published message; empty for requests, and if one side has no message."""
    before, after = _fields(one.recorded), _fields(one.now)
    if not (before and after):
        return []
    found = []
    for name in {**before, **after}:
        texts = before.get(name, "nothing"), after.get(name, "nothing")
        if texts[0] != texts[1]:
            since, until = _around(*texts) if min(map(len, texts)) > _LONGEST else (0, _LONGEST)
            found.append(ChangedField(name, *(_part(text, since, until) for text in texts)))
    return found


def message_name(one: Difference) -> str:
    """Return the envelope of the published message in a difference."""
    output = one.recorded or one.now
    return (output.key or output.message) if output else ""


def where(one: Difference) -> str:
    """Return the time (UTC) and the packet of a difference, as text."""
    at = day_and_time(one.at_ns, UTC)
    if one.packet is None:
        return f"{at}, before the first packet"
    when = "at" if one.at_ns == one.packet.time_ns else "after"
    return f"{at}, {when} the packet {one.packet.envelope}"


def _fields(output: Output | None) -> dict[str, str]:
    if output is None or not isinstance(output.value, bytes):
        return {}
    try:
        thing = wire.decode(output.message, output.value)
    except AfspmError:  # a request, or a message of a package that is not installed here
        return {}
    if isinstance(thing, Message):
        thing = wire.as_plain(thing)
    return dict(_flat("", thing))


def _flat(name: str, value: object) -> Iterator[tuple[str, str]]:
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _flat(f"{name}.{key}" if name else str(key), item)
    elif isinstance(value, list | tuple):
        for number, item in enumerate(value):
            yield from _flat(f"{name}[{number}]", item)
    elif isinstance(value, np.ndarray):
        # the text of an array leaves most of its values out
        yield name, f"{' × '.join(map(str, value.shape))} values, CRC {crc32(value.tobytes()):08x}"
    else:
        yield name, value if isinstance(value, str) else repr(value)


def _around(before: str, after: str) -> tuple[int, int]:
    pairs = enumerate(zip(before, after, strict=False))
    common = next((at for at, (one, other) in pairs if one != other), 0)
    return max(0, common - _AROUND), common + _AROUND


def _side(output: Output | None, since: int = 0, until: int = _LONGEST) -> str:
    if output is None:
        return "nothing"
    text = _part(output.text, since, until)
    return text if output.reaches else f"{output.key or output.message}: {text}"


def _part(text: str, since: int, until: int) -> str:
    return f"{'…' if since else ''}{text[since:until]}{'…' if until < len(text) else ''}"


def _place(output: Output) -> str:
    packet = output.packet
    return "none" if packet is None else f"{packet.envelope} of {day_and_time(packet.time_ns, UTC)}"
