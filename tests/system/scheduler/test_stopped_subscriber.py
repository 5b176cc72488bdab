"""A subscriber that is stopped while large scans are published: its packets are dropped, and replayed later."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm import wire
from afspm.model import Region, Scan
from afspm.supervisor.ports import SocketFolder
from afspm.wire.messages import SCAN

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="a process is stopped by a signal, and its peak memory is read from /proc"
)
PIXELS = 2048
SCAN_BYTES = 8 * PIXELS**2  # 32 MB
SCANS = 10
MOST_GROWTH_BYTES = 8 * SCAN_BYTES
"""The scans in the cache, being received, and being sent; with all that were published it would be eleven scans."""


class Listener:
    """`listener.py`, with the times of the scans that it has received."""

    def __init__(self, address: str, name: str) -> None:
        self.times: list[int] = []
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("listener.py")), address, name],
            stdout=subprocess.PIPE,
            encoding="utf-8",
        )
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.times.extend(int(line) for line in self.process.stdout)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._thread.join()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def listener(rig: Any) -> Iterator[Callable[[str], Listener]]:
    started: list[Listener] = []

    def start(name: str) -> Listener:
        started.append(Listener(rig.publish, name))
        return started[-1]

    yield start
    for one in started:
        one.close()


def memory_bytes(pid: int, field: str) -> int:
    """Return a field of /proc in bytes. VmRSS: resident now; VmHWM: the most resident so far."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(field))


@pytest.mark.parametrize("private", [True, False], ids=["unix", "tcp"])
def test_packets_for_a_stopped_subscriber_are_dropped_and_replayed_to_it_later(
    rig: Any, listener: Callable[[str], Listener], private: bool
) -> None:
    folder = SocketFolder()
    try:
        if private:
            rig.publish = folder.address()
        rig.start()
        _require_dropped(rig, listener)
    finally:
        folder.close()


def _require_dropped(rig: Any, listener: Callable[[str], Listener]) -> None:
    stopped, healthy = listener("Stopped"), listener("Healthy")
    scan = Scan(Region((0.0, 0.0), (2e-6, 2e-6)), "Height", "m", np.zeros((PIXELS, PIXELS)), 1)
    payload = wire.encode(scan)[1]
    first_ns = rig.clock.now_ns() + 60 * 10**9  # later than what the scheduler says by itself: times stay as they are

    def publish(number: int) -> None:
        rig.translator.publish("Scan2d", payload, first_ns + 1_000_000 * number)

    # before the first scan: how much of it is released when the listeners have it, differs from run to run
    before = memory_bytes(rig.process.pid, "VmRSS")
    publish(0)
    rig.until(lambda: stopped.times and healthy.times)
    beating_s = rig.clock.monotonic_s() + 3.0  # its first heartbeat, which nothing shows, comes after two seconds
    rig.until(lambda: rig.clock.monotonic_s() > beating_s)
    stopped.process.send_signal(signal.SIGSTOP)
    for number in range(1, SCANS + 1):
        publish(number)
        rig.until(lambda number=number: len(healthy.times) > number)
    assert healthy.times == [first_ns + 1_000_000 * number for number in range(SCANS + 1)]

    def grown() -> int:
        return memory_bytes(rig.process.pid, "VmRSS") - before

    rig.until(lambda: grown() < MOST_GROWTH_BYTES < SCANS * SCAN_BYTES)

    stopped.process.send_signal(signal.SIGCONT)
    rig.until(lambda: stopped.times[-1] == healthy.times[-1])
    assert stopped.times == sorted(set(stopped.times))
    kept = SCAN.history
    assert stopped.times[-kept:] == healthy.times[-kept:]
    assert len(stopped.times) <= SCANS  # the others were dropped
    publish(SCANS + 1)
    rig.until(lambda: stopped.times[-1] == healthy.times[-1] == first_ns + 1_000_000 * (SCANS + 1))
