"""Scans and spectra of a run as files, and their rows in the journal."""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from afspm import wire
from afspm.basics.clock import iso_utc
from afspm.basics.errors import InvalidValue
from afspm.model import TOPOGRAPHY, Packet, ProblemNames, Scan
from afspm.record import nexus_writer, provenance
from afspm.record.journal import SCHEDULER
from afspm.record.nexus_writer import FileProvenance
from afspm.record.provenance import ControlAtStart
from afspm.record.scan_assembler import Assembled, AssembledScan, AssembledSpectrum
from afspm.storage.atomic import FileBatch, replace_file
from afspm.wire.values import without_values

SCANS, SPECTRA = "scans", "spectra"
SUFFIX = ".h5"
_log = logging.getLogger("afspm.record")
PART = ".part"


class MeasuredFiles:
    """The writer of measurement files and their journal rows, within the open transaction.

    Args:
        folder: the folder of the run.
        facts: facts of the run, written into every file.
        speed: experiment seconds per real second.
    """

    def __init__(
        self,
        folder: Path,
        journal: sqlite3.Connection,
        facts: Mapping[str, object],
        problems: ProblemNames,
        speed: float = 1.0,
    ) -> None:
        self._folder = folder
        self._journal = journal
        self._facts = facts
        self._problems = problems
        self._speed = speed
        self._batch = FileBatch(PART)
        for kind in (SCANS, SPECTRA):
            for half in (folder / kind).glob(f"*{SUFFIX}{PART}"):  # of a process that was killed
                half.unlink(missing_ok=True)

    def write(self, taken: Assembled) -> None:
        """Write the file and the rows of the journal. Raises OSError, sqlite3.OperationalError: disk full …"""
        if isinstance(taken, AssembledSpectrum):
            self._write_spectrum(taken)
        elif taken.interrupted_ns is None:
            self._write_scan(taken)
        else:
            self._write_interrupted(taken, taken.interrupted_ns)

    def finish(self) -> None:
        """Sync all files to the disk and give them their final names. Raises OSError."""
        self._batch.finish()

    def discard(self) -> None:
        """Remove all files that do not have their final names yet."""
        self._batch.discard()

    def unlisted(self) -> list[str]:
        """Return the files in no table: a power cut took their packets, or a damaged journal was put aside."""
        listed, found = set[str](), set[str]()
        for kind in (SCANS, SPECTRA):
            listed |= {name for (name,) in self._journal.execute(f"SELECT file FROM {kind}")}
            found |= {f"{kind}/{path.name}" for path in (self._folder / kind).glob(f"*{SUFFIX}")}
        return sorted(found - listed)

    def close(self) -> None:
        self._batch.close()

    # --- scans ---

    def _write_scan(self, taken: AssembledScan) -> None:
        packet, first = taken.channels[0]
        published_ns = packet.time_ns or 0
        measured_ns = published_ns if first.time_ns is None else first.time_ns
        new: dict[str, Scan] = {}
        for _, scan in taken.channels:
            # a restarted translator publishes channels again: the first counts
            new.setdefault(scan.channel, scan)
        known = self._find_recorded(new, measured_ns)
        if known is None:
            stood = provenance.control_at_start(self._journal, published_ns, first)
            number = self._add_scan(list(new.values()), measured_ns, stood, published_ns, interrupted=False)
        else:
            number = known[0]
            self._add_channels(number, self._folder / known[1], new)
        self._insert_scan_packets(taken, number)

    def _find_recorded(self, new: Mapping[str, Scan], measured_ns: int) -> tuple[int, str] | None:
        rows = self._journal.execute(
            "SELECT number, file FROM scans WHERE time_ns = ? AND NOT interrupted ORDER BY number", (measured_ns,)
        )
        for number, file in rows.fetchall():
            there = dict(self._channels(number))
            if all(there.get(channel, scan.filename) == scan.filename for channel, scan in new.items()):
                return number, file
        return None

    def _channels(self, number: int) -> Iterator[tuple[str, str]]:
        rows = self._journal.execute("SELECT payload FROM packets WHERE scan = ? AND message = 'Scan2d'", (number,))
        for (payload,) in rows:
            message: Any = wire.message_type("Scan2d").FromString(payload)
            yield message.channel, message.filename

    def _write_interrupted(self, taken: AssembledScan, time_ns: int) -> None:
        scans = taken.as_seen()
        stood = provenance.control_at_start(self._journal, time_ns, None)
        number = self._add_scan(scans, time_ns, stood, time_ns, interrupted=True)
        self._insert_scan_packets(taken, number)

    def _add_scan(
        self, scans: Sequence[Scan], time_ns: int, stood: ControlAtStart, published_ns: int, *, interrupted: bool
    ) -> int:
        filename = scans[0].filename if scans else ""
        scans = sorted(scans, key=lambda scan: TOPOGRAPHY not in scan.roles)  # programs open the first
        number, name = self._next(SCANS, time_ns)
        facts = {**self._facts, **stood.facts(self._problems), "number": number, "interrupted": interrupted}
        filenames = {scan.filename for scan in scans}  # some controllers write a file for each channel
        mapping = provenance.drift(self._journal, published_ns, stood.began_ns, filenames)
        if mapping is not None:
            facts["drift"] = mapping
        facts |= self._surroundings(published_ns, stood, filenames, time_ns)
        at = FileProvenance(time_ns, stood.began_ns, facts, header_of(filename, self._folder))
        if scans:
            self._batch.write(self._folder / name, nexus_writer.encode_scan(scans, at))
        region, shape = (scans[0].region, scans[0].shape) if scans else (None, (None, None))
        place = (None,) * 5 if region is None else (*region.center_m, *region.size_m, region.angle_rad)
        frame = None if region is None else region.frame.value
        channels = json.dumps([[scan.channel, scan.unit] for scan in scans], ensure_ascii=False)
        self._journal.execute(
            f"INSERT INTO scans VALUES ({', '.join('?' * 18)})",
            (number, time_ns, stood.began_ns, filename, name if scans else "", interrupted, *place, frame, *shape,
             channels, *self._control(stood)),
        )  # fmt: skip
        return number

    def _add_channels(self, number: int, path: Path, new: Mapping[str, Scan]) -> None:
        # the recorder was killed between writing the file and these channels
        from afspm.storage.formats import read

        self._batch.finish()  # the file may be in the open batch
        content = read(path)
        there = {scan.channel for scan in content.scans}
        if new.keys() <= there:
            return
        scans = [*content.scans, *(scan for channel, scan in new.items() if channel not in there)]
        about = nexus_writer.facts_of(path)
        at = FileProvenance(about["time_ns"], about["began_ns"], about, header_of(scans[0].filename, self._folder))
        self._batch.write(path, nexus_writer.encode_scan(scans, at))
        channels = json.dumps([[scan.channel, scan.unit] for scan in scans], ensure_ascii=False)
        self._journal.execute("UPDATE scans SET channels = ? WHERE number = ?", (channels, number))

    def _insert_scan_packets(self, taken: AssembledScan, number: int) -> None:
        (channels,) = self._journal.execute("SELECT channels FROM scans WHERE number = ?", (number,)).fetchone()
        in_file = {channel for channel, _ in json.loads(channels)}
        for packet, lines in taken.lines:
            if lines.channel not in in_file:  # the scan ended before this channel was published
                insert_packet(self._journal, packet, "ScanLines", bytes(packet.payload))
                continue
            head = without_values("ScanLines", packet.payload)
            rows = (lines.channel, lines.first_row, len(lines.values))
            insert_packet(self._journal, packet, "ScanLines", head, scan=number, rows=rows)
        for packet, scan in taken.channels:
            head = without_values("Scan2d", packet.payload)
            insert_packet(self._journal, packet, "Scan2d", head, scan=number, rows=(scan.channel, None, None))

    # --- spectra ---

    def _write_spectrum(self, taken: AssembledSpectrum) -> None:
        packet, spectrum = taken.packet, taken.spectrum
        published_ns = packet.time_ns or 0
        time_ns = published_ns if spectrum.time_ns is None else spectrum.time_ns
        # a restarted translator or component publishes a spectrum again: it is recorded once
        known = self._journal.execute(
            "SELECT number, x, y, points FROM spectra WHERE time_ns = ? AND filename = ? AND kind = ?",
            (time_ns, spectrum.filename, spectrum.kind),
        ).fetchone()
        place = (None, None) if spectrum.position_m is None else spectrum.position_m
        if known is not None and known[1:] != (*place, spectrum.values.shape[0]):
            what = f"another spectrum {spectrum.kind!r} has the same time: number {known[0]}"
            raise InvalidValue(what, hint="give each spectrum the time of its own measurement")
        if known is None:
            stood = provenance.control_at_start(self._journal, published_ns, spectrum)
            number, name = self._next(SPECTRA, time_ns)
            facts = {**self._facts, **stood.facts(self._problems), "number": number}
            facts |= self._surroundings(published_ns, stood, {spectrum.filename}, time_ns)
            at = FileProvenance(time_ns, stood.began_ns, facts, header_of(spectrum.filename, self._folder))
            self._batch.write(self._folder / name, nexus_writer.encode_spectrum(spectrum, at))
            names, units = (json.dumps(texts, ensure_ascii=False) for texts in (spectrum.names, spectrum.units))
            self._journal.execute(
                f"INSERT INTO spectra VALUES ({', '.join('?' * 15)})",
                (number, time_ns, stood.began_ns, spectrum.filename, name, spectrum.kind, *place, spectrum.frame.value,
                 spectrum.values.shape[0], names, units, *self._control(stood)),
            )  # fmt: skip
        else:
            number = known[0]
        insert_packet(self._journal, packet, "Spec1d", without_values("Spec1d", packet.payload), spectrum=number)

    # --- both ---

    def _next(self, kind: str, time_ns: int) -> tuple[int, str]:
        number = int(self._journal.execute(f"SELECT coalesce(max(number), 0) + 1 FROM {kind}").fetchone()[0])
        name = f"{kind}/{_stamp(time_ns)}-{number:05d}{SUFFIX}"
        for orphan in (self._folder / kind).glob(f"{_stamp(time_ns)}-*{SUFFIX}"):
            if self._journal.execute(f"SELECT 1 FROM {kind} WHERE file = ?", (f"{kind}/{orphan.name}",)).fetchone():
                continue
            orphan.unlink()  # written right before a kill; the journal never got its number
        return number, name

    def _surroundings(
        self, published_ns: int, stood: ControlAtStart, filenames: Collection[str], measured_ns: int
    ) -> dict[str, object]:
        since_ns = stood.began_ns
        found = {
            "instruments": provenance.instruments(self._journal, published_ns, since_ns, self._speed),
            "tip": provenance.tip(self._journal, published_ns, since_ns, filenames, measured_ns),
            "in_force": provenance.in_force(self._journal, published_ns, since_ns, filenames, measured_ns),
        }
        return {name: facts for name, facts in found.items() if facts}

    def _control(self, stood: ControlAtStart) -> tuple[str | None, str | None, str]:
        facts = stood.facts(self._problems)
        problems = json.dumps(facts.get("problems", []), ensure_ascii=False)
        return facts.get("in_control"), facts.get("mode"), problems


def insert_packet(
    journal: sqlite3.Connection,
    packet: Packet,
    message: str,
    payload: bytes,
    *,
    source: str = SCHEDULER,
    scan: int | None = None,
    spectrum: int | None = None,
    rows: tuple[str | None, int | None, int | None] = (None, None, None),
) -> None:
    """Insert the row of a packet.

    Args:
        payload: the part stored in the journal; the values are in the file of `scan` or `spectrum`.
        rows: (channel, first row, number of rows) of a scan's values.
    """
    journal.execute(
        "INSERT INTO packets VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (packet.time_ns or 0, packet.envelope, message, source, payload, scan, spectrum, *rows),
    )


def header_of(filename: str, folder: Path) -> Mapping[str, object]:
    """Return the header of the controller's own file; empty if that file is on another computer, or can't be read."""
    from afspm.storage.formats import read

    path = folder / filename if filename else folder
    try:
        if not path.is_file():
            return {}
        content = read(path)
    except Exception as error:  # unreachable folder, or any error of a package's reader: the scan is recorded without
        _log.debug("the header of %s is left out: %s", filename, error)
        return {}
    return {"controller": content.controller, **content.header}


def write_synced(path: Path, data: bytes) -> None:
    """Write a file atomically, also across a power cut. Raises OSError."""
    replace_file(path, [data], aside=path.with_name(path.name + PART))


def _stamp(time_ns: int) -> str:
    # no dot: programs that cut a file name at its first dot still show the whole time
    return iso_utc(time_ns).replace("-", "").replace(":", "").replace(".", "_")
