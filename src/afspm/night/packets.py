"""Packets read from the record, whole or without the values that are in files, and their playback in time."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from afspm import wire
from afspm.basics.errors import FileError, WireError
from afspm.model import Frame, Packet, Scan, Spectrum
from afspm.night.measured_tables import Row
from afspm.record import measured_file
from afspm.record.journal import SCHEDULER
from afspm.wire.messages import parse
from afspm.wire.values import with_nan, with_values

if TYPE_CHECKING:
    import numpy as np
    from google.protobuf.message import Message
    from numpy.typing import NDArray

    from afspm.storage.formats.content import FileContent

Query = Callable[[str, Sequence[object]], list[Row]]
"""A function that runs a query on the journal. Raises FileError if the journal is damaged."""

_log = logging.getLogger("afspm.record")
_AT_ONCE = 500
_FILES_KEPT = 4
_PACKETS_KEPT = 64
_LAST = chr(0x10FFFF)  # sorts after every envelope
_COLUMNS = "time_ns, envelope, message, payload, scan, spectrum, channel, first_row, rows"


class Timed(Protocol):
    """A recorded item with the time of its publication."""

    @property
    def time_ns(self) -> int | None: ...


T = TypeVar("T", bound=Timed)


class RecordPlayback(Generic[T]):
    """The playback of recorded items when they are due, oldest first, to a page or to components.

    The caller provides the time: a running clock, or the moment chosen by a viewer.
    """

    def __init__(self, things: Iterable[T]) -> None:
        self._things = iter(things)
        self._next = next(self._things, None)

    @property
    def next_ns(self) -> int | None:
        """The time of the next item; None after the last."""
        return None if self._next is None else self._next.time_ns or 0

    def due(self, now_ns: int) -> Iterator[T]:
        """Yield all items up to `now_ns`; a caller that stops early loses none."""
        while self._next is not None and (self._next.time_ns or 0) <= now_ns:
            thing, self._next = self._next, next(self._things, None)
            yield thing


def packets(
    query: Query,
    folder: Path,
    since_ns: int,
    messages: Sequence[str] | None,
    tell: Callable[[str], None] | None,
) -> Iterator[Packet]:
    """Yield packets of the scheduler as they were published, oldest first; arguments as of `Run.packets`."""
    values, reasons = _Values(query, folder), set[str]()
    for row in _rows(query, since_ns, messages):
        try:
            found = _packet(row, values)
        except FileError as error:
            if (why := str(error)) not in reasons:  # once a file, not for each of its packets
                reasons.add(why)
                (tell or partial(_log.warning, "packets are left out: %s"))(why)
            continue
        yield found


def without_reading_files(
    query: Query, frame: Frame, messages: Sequence[str] | None, types: Mapping[str, type[Message]]
) -> Iterator[tuple[Packet, str, Any]]:
    """Yield packet, message name and decoded content; scans and spectra have the right shape and NaN for values.

    Lines of running scans and unreadable packets are left out.

    Args:
        types: the types of the user's messages that the record describes.
    """
    for time_ns, envelope, message, payload, scan, spectrum, _, _, _ in _rows(query, -1, messages):
        if not message or message == "ScanLines":
            continue
        try:
            if message in types:
                thing = parse(types[message], payload)
            else:
                thing = wire.decode(message, payload if spectrum is None else with_nan(payload))
            if isinstance(thing, Scan) and scan is not None:
                thing = replace(thing, values=_nan(thing.shape))
            elif isinstance(thing, Spectrum):
                thing = replace(thing, values=_nan(thing.values.shape))
        except WireError:
            continue
        yield Packet(envelope, payload, time_ns), message, _placed(thing, frame)


class PacketLookup:
    """A lookup of single packets of the scheduler, which keeps the newest packets and the contents of their files.

    A replay reads each channel of a scan by itself, for each component: reading files took nine tenths of its time.
    """

    def __init__(self, query: Query, folder: Path) -> None:
        self._query, self._folder = query, folder
        self._values = _Values(query, folder)
        self._kept: OrderedDict[tuple[int, str], Packet] = OrderedDict()

    def __call__(self, time_ns: int, envelope: str) -> Packet:
        """Return the packet published at a time with an envelope.

        Raises:
            FileError: no such packet, or its file is missing or damaged.
        """
        key = (time_ns, envelope)
        if key not in self._kept:
            sql = f"SELECT {_COLUMNS} FROM packets WHERE source = ? AND time_ns = ? AND envelope = ?"
            rows = self._query(sql, (SCHEDULER, *key))
            if not rows:
                raise FileError(f"the record lacks the packet {envelope} of {time_ns} ns", where=str(self._folder))
            self._kept[key] = _packet(rows[0], self._values)
            if len(self._kept) > _PACKETS_KEPT:
                self._kept.popitem(last=False)
        return self._kept[key]


def _rows(query: Query, since_ns: int, messages: Sequence[str] | None) -> Iterator[Row]:
    # in batches: a slow reader then blocks no writer, and sees rows written meanwhile
    wanted = "" if messages is None else f" AND message IN ({', '.join('?' * len(messages))})"
    sql = f"SELECT {_COLUMNS} FROM packets WHERE source = ? AND (time_ns, envelope) > (?, ?){wanted}"
    sql += f" ORDER BY time_ns, envelope LIMIT {_AT_ONCE}"
    after = (since_ns, _LAST)
    while rows := query(sql, (SCHEDULER, *after, *(messages or ()))):
        yield from rows
        after = rows[-1][:2]


def _packet(row: Row, values: _Values) -> Packet:
    time_ns, envelope, message, payload, *place = row
    found = values.of(*place)
    return Packet(envelope, payload if found is None else with_values(message, payload, found), time_ns)


def _nan(shape: tuple[int, ...]) -> NDArray[np.float64]:
    import numpy as np

    return np.broadcast_to(np.nan, shape)  # a view of one value, so it takes no memory


def _placed(thing: object, frame: Frame) -> object:
    if frame is Frame.TIP:
        return thing
    if isinstance(thing, Scan):
        return replace(thing, region=replace(thing.region, frame=frame))
    return replace(thing, frame=frame) if isinstance(thing, Spectrum) else thing


class _Values:
    """The values of packets, read from files; a few contents are kept, since channels of a scan come together."""

    def __init__(self, query: Query, folder: Path) -> None:
        self._query = query
        self._folder = folder
        self._kept: OrderedDict[str, FileContent] = OrderedDict()

    def of(
        self, scan: int | None, spectrum: int | None, channel: str | None, first_row: int | None, rows: int | None
    ) -> NDArray[np.float64] | None:
        """Return the values of a packet; None if the packet has them. Raises FileError: no file, or a damaged file."""
        if spectrum is not None:
            return self._content("spectra", spectrum).spectra[0].values
        if scan is None:
            return None
        content = self._content("scans", scan)
        values = next((s.values for s in content.scans if s.channel == channel), None)
        if values is None:
            raise FileError(f"channel {channel!r} is missing", where=f"scan {scan} of {self._folder}")
        return values if first_row is None else values[first_row : first_row + (rows or 0)]

    def _content(self, table: str, number: int) -> FileContent:
        from afspm.storage.formats import read

        ((file,),) = self._query(f"SELECT file FROM {table} WHERE number = ?", (number,))
        if file not in self._kept:
            self._kept[file] = read(measured_file(self._folder, file))
            if len(self._kept) > _FILES_KEPT:
                self._kept.popitem(last=False)
        return self._kept[file]
