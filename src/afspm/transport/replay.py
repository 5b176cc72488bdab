"""How one subscriber asks for what was published before it came, and is sent it alone.

A subscriber of ours subscribes to a marker, a topic of its own that also says what it wants:

    \\0replay/<name>/<nonce> \\0 <since_ns> \\0 <prefix> \\0 <prefix> …

The publisher sends what it has kept as `[topic, envelope, message, timestamp]` and at last `[topic]` alone, where topic
is the first part of the marker: nobody else is subscribed to that. A publisher of version 1 never publishes anything
that begins so, and ignores it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

_BEGIN = b"\0replay/"
LONGEST = 8 << 10
"""Bytes of a marker."""
_MOST_PREFIXES = 1000

# An envelope is text: it begins with one of these. The empty prefix, "everything", is written as all of them, since as
# it stands it would also match the replays that are meant for others.
FIRST_BYTES = tuple(bytes([n]) for n in (*range(0x20, 0x7F), *range(0xC2, 0xF5)))


class Marker(NamedTuple):
    """What a subscriber asks for.

    Attributes:
        topic: what its replay is published under.
        since_ns: it has everything up to this time.
        prefixes: of the envelopes that it wants.
    """

    topic: bytes
    since_ns: int
    prefixes: tuple[str, ...]

    @property
    def name(self) -> str:
        """Of the subscriber."""
        return self.topic[len(_BEGIN) :].rpartition(b"/")[0].decode("utf-8", "replace")

    def encode(self) -> bytes:
        return b"\0".join([self.topic, b"%d" % self.since_ns, *(prefix.encode() for prefix in self.prefixes)])

    @classmethod
    def decode(cls, subscription: bytes) -> Marker | None:
        """None if the subscription is an ordinary prefix, or no proper marker."""
        if not subscription.startswith(_BEGIN) or len(subscription) > LONGEST:
            return None
        parts = subscription[1:].split(b"\0")
        if not 3 <= len(parts) <= _MOST_PREFIXES + 2:
            return None
        try:
            since_ns = int(parts[1])
            prefixes = tuple(str(part, "utf-8") for part in parts[2:])
        except ValueError:
            return None
        return cls(b"\0" + parts[0], since_ns, prefixes)


def topic(name: str, nonce: int) -> bytes:
    """A topic of the subscriber `name`; another one every time it asks."""
    return _BEGIN + name.replace("\0", "").encode() + b"/%d" % nonce


def is_reserved(subscription: bytes) -> bool:
    """Whether this begins like a marker, well-formed or not."""
    return subscription.startswith(b"\0")


def spelled_out(prefixes: Iterable[bytes]) -> list[bytes]:
    """The prefixes to really subscribe to: the empty one as all that an envelope may begin with."""
    found: list[bytes] = []
    for prefix in prefixes:
        found.extend([prefix] if prefix else FIRST_BYTES)
    return found
