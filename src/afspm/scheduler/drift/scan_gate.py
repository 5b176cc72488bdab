"""A scan waits until it is known where it lies, and with it all that the microscope publishes after it.

So the channels of a scan all get the same mapping, the best that is known, and the order of packets is kept.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass

from afspm.logic.events import PacketIn, TranslatorCaughtUp
from afspm.model import Scan
from afspm.model.geometry import XY
from afspm.units import same_kind

Matrix = list[list[float]]
Waits = PacketIn | TranslatorCaughtUp

_SETTLED = 32


@dataclass
class HeldScan:
    """A scan that is waited for.

    Attributes:
        middle_s: experiment time that its position stands for.
        until_s: real time until which it is waited for.
        filename, center_m: of its first channel, in tip coordinates.
        asked: it is being registered.
        tries: how often that was begun.
    """

    key: str
    middle_s: float
    until_s: float
    filename: str
    center_m: XY
    asked: bool = False
    tries: int = 0


class ScanGate:
    """Keeps packets back, and knows the mapping of each scan that has been let through."""

    def __init__(self) -> None:
        self.held: HeldScan | None = None
        self._waiting: deque[Waits] = deque()
        self._settled: OrderedDict[str, Matrix | None] = OrderedDict()

    def hold(self, held: HeldScan) -> None:
        """From now on packets wait for this scan."""
        self.held = held

    def keep(self, event: Waits) -> None:
        """Let a packet, or the word that there are no more old ones, wait."""
        self._waiting.append(event)

    def next_ns(self) -> int | None:
        """The translator's time of the first packet that waits."""
        return next((event.packet.time_ns for event in self._waiting if isinstance(event, PacketIn)), None)

    def is_settled(self, key: str) -> bool:
        return key in self._settled

    def mapping_of(self, key: str) -> Matrix | None:
        """Of a scan that is settled; None: it is given as the microscope gave it."""
        return self._settled[key]

    def settle(self, key: str, matrix: Matrix | None) -> None:
        """A scan has this mapping, now and whenever it should be published again."""
        self._settled[key] = matrix
        if len(self._settled) > _SETTLED:
            self._settled.popitem(last=False)

    def open(self) -> deque[Waits]:
        """No scan is waited for any more. Returns what waited, in order."""
        self.held = None
        waiting, self._waiting = self._waiting, deque()
        return waiting

    def to_list(self) -> list[tuple[str, Matrix | None]]:
        """The mappings as plain JSON."""
        return list(self._settled.items())

    def restore(self, plain: list[tuple[str, Matrix | None]]) -> None:
        for key, matrix in plain:
            self.settle(str(key), matrix)


class DriftChannel:
    """The channel that is registered: as set, or the first in a unit of length."""

    def __init__(self, name: str | None) -> None:
        self.name = name

    def is_of(self, scan: Scan) -> bool:
        """Return whether a scan is of this channel."""
        if self.name is None and same_kind(scan.unit, "m"):
            self.name = scan.channel
        return scan.channel == self.name

    def missing(self) -> str:
        """Return why a scan without it is not registered."""
        return f"without the channel {self.name or 'in a unit of length'} it can't be used for drift"
