"""The cost of recording for an experiment, and the time to open a long run."""

from __future__ import annotations

import itertools
import os
import statistics
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from unittest import mock

import numpy as np

import afspm
from afspm import wire
from afspm.model import ControlMode, ControlState, Packet, Region, Scan, ScopeState, ScopeStatus
from afspm.record import journal
from afspm.record.journal import SCHEDULER
from afspm.record.measured_files import write_synced
from afspm.record.store import RecordSettings, RecordStore
from afspm.storage.packet_log import START, LogReader, committed, log_folder
from benchmarks.codec import scan
from benchmarks.control import Client
from benchmarks.effort import effort
from benchmarks.processes import roles
from benchmarks.rows import Row, alternate, measurement
from benchmarks.scans import Line

ALTERNATIONS = effort(9, 1)
FLOODS = effort(5, 1)
PACE_S = 0.1
"""Between scans at a realistic rate: ten channels of 512² a second are more than any microscope takes."""
PACED = effort(20, 1)
FAST = 20
"""Scans of 512² a second: 40 MB/s, more than microscopes deliver."""
WARM = effort(6, 1)
FLOOD = effort(60, 2)
"""Scans as fast as they can be sent: more than a gigabyte a second, which few disks take. Then each costs what it takes
to append it to the log; the recorder works when there is nothing else to do."""
RECORDED_WITHIN_S = 120.0
SCANS, OPENED = effort((10_000, 5), (10, 1))
START_NS = 1_773_518_400_000_000_000
_SCAN, _NUMBERS = scan(512), itertools.count()


@measurement
def recording() -> Iterator[Row]:
    """Compare runs with a recorder and without."""
    with roles() as processes:
        clients = []
        for recorded in (True, False):
            publish, serve = processes.start("translator").split()
            clients.append(Client(processes, processes.scheduler(publish, serve, recorded=recorded)[1]))
        with_record, without = alternate(clients[0].round_trip_us, clients[1].round_trip_us, ALTERNATIONS)
        yield Row("control round trip, recorded", "µs", with_record, without, 1.1)
    payload = wire.encode(scan(512))[1]
    with roles() as processes:
        recorded_line, line = RecordedLine(processes), FreshLine(processes)
        recorded_line.ours(1, recorded=True)
        line.ours(1)

        for one in (recorded_line, line):  # as after some minutes: what is written goes over what was
            for _ in range(WARM):
                _at_pace_per_s(one, payload)
        recorded_line.wait_until_sure()

        def both(measure: Callable[..., float], times: int) -> tuple[float, float]:
            def with_record() -> float:
                took = measure(recorded_line, payload)
                recorded_line.wait_until_recorded()  # nothing is recorded while the other is measured
                return took

            return alternate(with_record, partial(measure, line, payload), times)

        yield Row("a scan of 512² on its way, ten a second, recorded", "ms", *both(_paced_ms, ALTERNATIONS), 2.0)
        at_pace = both(_at_pace_per_s, ALTERNATIONS)
        yield Row(f"scans of 512², {FAST} a second, recorded", "1/s", *at_pace, 0.95, "high")
        bare = FreshLine(processes)
        bare.bare(1)

        def flood_with_log() -> float:
            took = _flood_per_s(recorded_line, payload)
            recorded_line.wait_until_sure()
            return took

        floods = alternate(flood_with_log, partial(_flood_per_s, bare, payload), FLOODS)
        yield Row("scans of 512² through the scheduler, logged and recorded", "1/s", *floods, 0.5, "high")
        ours, written = alternate(
            partial(_recorded_mb_per_s, recorded_line, payload), partial(_written_mb_per_s, payload), FLOODS
        )
        yield Row("a flood until its files are written, beside a bare write", "MB/s", ours, written, 0.25, "high")


class FreshLine(Line):
    """A line that publishes a different scan each time: a repeated scan is not recorded again."""

    def scans_per_s(self, payload: bytes, count: int) -> float:
        fresh = iter([_fresh() for _ in range(count)])
        publish = self._publish
        self._publish = lambda envelope, it: publish(envelope, next(fresh) if envelope == b"Scan2d" else it)
        try:
            return super().scans_per_s(payload, count)
        finally:
            self._publish = publish


def _fresh() -> bytes:
    return wire.encode(replace(_SCAN, time_ns=START_NS + next(_NUMBERS) * 1_000_000_000))[1]


class RecordedLine(FreshLine):
    """A line with a recorder beside it."""

    def ours(self, subscribers: int, *, recorded: bool = False) -> None:
        super().ours(subscribers, recorded=recorded)
        self._folder = self._processes.run_folder
        self._published = 0

    def scans_per_s(self, payload: bytes, count: int) -> float:
        self._published += count
        return super().scans_per_s(payload, count)

    def wait_until_recorded(self) -> None:
        """Wait until all scans are recorded but the last, which waits a second for more channels."""
        counted = "SELECT count(*) FROM packets WHERE message = 'Scan2d'"
        self._wait(lambda asked: asked(counted) >= self._published - 1)

    def wait_until_sure(self) -> None:
        """Wait until the write-ahead log may be overwritten."""
        self.wait_until_recorded()
        log = log_folder(self._folder)
        self._wait(lambda asked: not LogReader(log, committed(log) or START).read(1))

    def _wait(self, is_so: Callable[[Callable[[str], int]], bool]) -> None:
        deadline = perf_counter() + RECORDED_WITHIN_S
        with closing(journal.open_to_read(self._folder)) as opened:
            while not is_so(lambda sql: int(opened.execute(sql).fetchone()[0])):
                if perf_counter() > deadline:
                    raise TimeoutError("what was published is not recorded")
                self.rest(0.02)


def _paced_ms(line: Line, payload: bytes) -> float:
    # from the publication of a scan to its arrival
    times = []
    for _ in range(PACED):
        began = perf_counter()
        times.append(1e3 / line.scans_per_s(payload, 1))
        while perf_counter() < began + PACE_S:
            line.rest(began + PACE_S - perf_counter())
    return statistics.median(times)


def _at_pace_per_s(line: Line, payload: bytes) -> float:
    # arriving scans per second, of scans published at an even pace
    began = perf_counter()
    for number in range(FAST):
        while (left_s := began + number / FAST - perf_counter()) > 0.0:
            line.rest(left_s)
        line.scans_per_s(payload, 1)
    return FAST / (perf_counter() - began)


def _flood_per_s(line: Line, payload: bytes) -> float:
    return line.scans_per_s(payload, FLOOD)


def _recorded_mb_per_s(line: RecordedLine, payload: bytes) -> float:
    # until the flood is in the record, on the disk
    began = perf_counter()
    line.scans_per_s(payload, FLOOD)
    line.wait_until_recorded()
    return FLOOD * len(payload) * 1e-6 / (perf_counter() - began)


def _written_mb_per_s(payload: bytes) -> float:
    # each scan is a plain file, synced as the recorder does
    with tempfile.TemporaryDirectory() as folder:
        began = perf_counter()
        for number in range(FLOOD):
            write_synced(Path(folder) / str(number), payload)
        return FLOOD * len(payload) * 1e-6 / (perf_counter() - began)


@measurement
def long_run() -> Iterator[Row]:
    """Measure a run of ten thousand scans: opening, its table, the last scan, and its overview."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write(folder)
        yield Row(
            f"a run of {SCANS} scans is open",
            "s",
            statistics.median(_open_s(folder) for _ in range(OPENED)),
            None,
            1.0,
        )


def _open_s(folder: Path) -> float:
    began = perf_counter()
    with afspm.open_run(folder) as run:
        table = run.scans
        assert len(table) == SCANS
        assert run.scan(-1).first.values.shape == (16, 16)
    return perf_counter() - began


def _write(folder: Path) -> None:
    values = np.random.default_rng(1).normal(size=(16, 16))
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    control = ControlState(ControlMode.AUTOMATED, "series")
    store = RecordStore(folder, RecordSettings({"experiment": "long"}))
    with mock.patch.object(os, "fsync"):  # only to be quick: no power cut here
        for number in range(SCANS):
            time_ns = START_NS + number * 60_000_000_000
            things: list[tuple[str, object]] = [
                ("ControlState", control),
                ("ScopeStateMsg", ScopeStatus(ScopeState.SCANNING)),
                ("Scan2d_1000.0_Height", Scan(region, "Height", "m", values, time_ns, f"scan-{number}.nc")),
                ("Scan2d_1000.0_Phase", Scan(region, "Phase", "deg", values, time_ns, f"scan-{number}.nc")),
                ("ScopeStateMsg", ScopeStatus(ScopeState.FREE)),
            ]
            store.take(
                (Packet(envelope, wire.encode(thing)[1], time_ns + at * 1_000_000), SCHEDULER)
                for at, (envelope, thing) in enumerate(things)
            )
    store.close()
