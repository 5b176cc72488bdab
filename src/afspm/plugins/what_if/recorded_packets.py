"""Lookup of a run's packets by time and envelope."""

from __future__ import annotations

from afspm.basics.errors import FileError
from afspm.model import Packet
from afspm.plugins.what_if.port_replay import PacketOf
from afspm.record.run import Run

_KEPT = 64
"""The number of packets kept in memory."""


def recorded_packets(record: Run) -> PacketOf:
    """Return a function that reads packets of a run, with their values from the run's files."""
    kept: dict[tuple[int, str], Packet] = {}

    def packet_of(time_ns: int, envelope: str) -> Packet:
        if (found := kept.get((time_ns, envelope))) is not None:
            return found
        for packet in record.packets(since_ns=time_ns - 1):  # `since_ns` itself is excluded
            if packet.time_ns != time_ns:
                break
            if packet.envelope == envelope:
                if len(kept) >= _KEPT:
                    del kept[next(iter(kept))]
                kept[time_ns, envelope] = packet
                return packet
        raise FileError(f"the record lacks the packet {envelope} of {time_ns} ns", where=str(record.folder))

    return packet_of
