"""The envelope under which the scheduler publishes and caches a packet, and the number of packets kept under it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from afspm import wire
from afspm.basics import Count
from afspm.basics.errors import ConfigError, InvalidValue, WireError
from afspm.basics.plain_data import SECTION
from afspm.basics.units import Length
from afspm.model import PacketHeader
from afspm.wire.messages import SCAN, SPECTRUM

EnvelopeMapping = Callable[[PacketHeader], str]


def default_envelope(header: PacketHeader) -> str:
    """Return the envelope of the wire format: "Scan2d_2000.0_Height", "Spec1d_IV", or else the name of the message."""
    if header.message == SCAN.name and header.size_m is not None:
        return f"{SCAN.name}_{size_text(header.size_m[0])}_{header.channel or ''}"
    if header.message == SPECTRUM.name and header.kind:
        return f"{SPECTRUM.name}_{header.kind}"
    return header.message


def tells(envelope: str, message: str) -> bool:
    """Return whether an envelope begins with the name of its message, from which subscribers know its type."""
    return envelope == message or envelope.startswith(f"{message}_")


def size_text(size_m: float) -> str:
    """Return a length as decimal text in nm, rounded to 1 nm unless it is shorter.

    >>> size_text(2e-6), size_text(2.5e-10)
    ('2000.0', '0.25')
    """
    # In nm for every unit of the scan: rounded metres would give scans of 5 nm and of 200 nm the same envelope.
    size_nm = size_m * 1e9
    if not math.isfinite(size_nm):
        return str(size_nm)
    if abs(size_nm) < 1.0:
        return str(float(f"{size_nm:.6g}"))
    return str(float(round(size_nm)))


@dataclass(frozen=True)
class CacheRule:
    """A rule of [cache]: the first that matches a packet decides its envelope, and how many are kept.

    Attributes:
        message: the name of the message; without the key: any.
        channel: of a scan; without the key: any.
        kind: of a spectrum; without the key: any.
        above_m: the region is wider than this.
        up_to_m: the region is not wider than this.
        envelope: text in which {message}, {channel}, {kind} and {size} (nm) are filled in; without the key: the
            default. It must begin with the name of its message, from which subscribers know its type, for example
            `Scan2d_wide_{channel}`.
        history: number of packets kept; without the key: the default.

    Raises:
        InvalidValue: the history is less than 1, no packet could match, or no subscriber could read the envelope.
    """

    message: str | None = None
    channel: str | None = None
    kind: str | None = None
    above_m: Length | None = None
    up_to_m: Length | None = None
    envelope: str | None = None
    history: Count | None = None

    __pydantic_config__: ClassVar[object] = SECTION

    def __post_init__(self) -> None:
        if self.history is not None and self.history < 1:
            raise InvalidValue(f"a history of {self.history} keeps nothing", where="[cache]", hint="1 or more")
        if self.envelope is not None:
            message = self.message or "AnyMessage"
            if not tells(self.name(PacketHeader(message, "", (0.0, 0.0), "")), message):
                raise InvalidValue(
                    f"the envelope {self.envelope!r} does not begin with the name of its message:"
                    " no subscriber could decode it",
                    where="[cache]",
                    hint=f"e.g. {self.message or '{message}'}_{self.envelope}",
                )
        if self.above_m is not None and self.up_to_m is not None and self.above_m >= self.up_to_m:
            raise InvalidValue("empty range: above must be less than up_to", where="[cache]")

    def fits(self, header: PacketHeader) -> bool:
        wanted = ((self.message, header.message), (self.channel, header.channel), (self.kind, header.kind))
        if any(want is not None and want != have for want, have in wanted):
            return False
        if self.above_m is None and self.up_to_m is None:
            return True
        if header.size_m is None:
            return False
        return (self.above_m is None or header.size_m[0] > self.above_m) and (
            self.up_to_m is None or header.size_m[0] <= self.up_to_m
        )

    def name(self, header: PacketHeader) -> str:
        """Return the envelope of a packet that matches this rule.

        Raises:
            InvalidValue: the text has another field than {message}, {channel}, {kind} and {size}.
        """
        if self.envelope is None:
            return default_envelope(header)
        size = "" if header.size_m is None else size_text(header.size_m[0])
        try:
            return self.envelope.format(
                message=header.message, channel=header.channel or "", kind=header.kind or "", size=size
            )
        except (KeyError, IndexError, ValueError) as error:
            raise InvalidValue(
                f"{self.envelope!r} can't be filled in: {error}",
                where="[cache]",
                hint="use {message}, {channel}, {kind} and {size}",
            ) from error


@dataclass(frozen=True)
class CacheSettings:
    """The section [cache]: envelopes of published packets, and numbers of packets kept for late joiners.

    Attributes:
        history: number of packets kept for each envelope, by message: `{ Scan2d = 10 }`.
        rules: list of tables; the first matching rule sets a packet's envelope and the number of packets kept.
        mapping: `"module.function"`: a function from a packet's header (`message`, `channel`, `size_m`, `kind`) to its
            envelope; replaces the envelopes of rules and defaults, not the rules' numbers.
    """

    history: Mapping[str, Count] = field(default_factory=dict)
    rules: tuple[CacheRule, ...] = ()
    mapping: str | None = None

    __pydantic_config__: ClassVar[object] = SECTION

    @property
    def envelopes(self) -> tuple[str, ...]:
        """The fixed beginnings of the rules' envelopes."""
        return tuple(re.split(r"[{}]", rule.envelope)[0] for rule in self.rules if rule.envelope)


class Envelopes:
    """The mapping from packets to envelopes, by the rules of the experiment file.

    Args:
        rules: the rules, tried in order before the defaults.
        mapping: a function of the user that names the envelope instead of rules and defaults; the rules still decide
            how many packets are kept.
        history: the number of packets to keep, by message, instead of the number in the declaration.
    """

    def __init__(
        self,
        rules: Sequence[CacheRule] = (),
        mapping: EnvelopeMapping | None = None,
        history: Mapping[str, int] | None = None,
    ) -> None:
        self._rules = tuple(rules)
        self._mapping = mapping
        self._history = history or {}

    def of(self, header: PacketHeader) -> tuple[str, int]:
        """Return the envelope of a packet, and how many packets of this envelope are kept.

        Raises:
            ConfigError: the user's function fails, or its envelope does not begin with the name of the message.
        """
        rule = next((rule for rule in self._rules if rule.fits(header)), None)
        history = self.history(header.message)
        if rule is not None and rule.history is not None:
            history = rule.history
        if self._mapping is not None:
            envelope = self._mapped(self._mapping, header)
            if not isinstance(envelope, str) or "\0" in envelope or not tells(envelope, header.message):
                raise ConfigError(
                    f"the mapping of envelopes gave {envelope!r} for {header.message}: no subscriber could decode it",
                    where="[cache]",
                    hint=f"a text without NUL: {header.message}, or what begins with {header.message}_",
                )
            return envelope, history
        return (default_envelope(header) if rule is None else rule.name(header)), history

    def history(self, message: str) -> int:
        """Return how many packets of a message are kept where no rule sets a number."""
        if (own := self._history.get(message)) is not None:
            return own
        try:
            return wire.declaration(message).history
        except WireError:
            return 1

    @staticmethod
    def _mapped(mapping: EnvelopeMapping, header: PacketHeader) -> object:
        try:
            return mapping(header)
        except Exception as error:  # the user's function may raise anything, and must not end the scheduler
            raise ConfigError(f"the mapping of envelopes fails: {error!r}", where="[cache]") from error
