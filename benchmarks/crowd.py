"""`python -m benchmarks.crowd [--scans N] [--subscribers M]`: plain subscribers that join and leave in crowds.

A run with `[security] insecure = true`, as published clients need it: scans of 256² at 300 times real time, the page
with viewers, and a component that logs much. In each half minute the plain SUB sockets of two crowds join, a quarter of
them read nothing, and leave again. The run must end by itself, no process may crash, every scan that was measured must
be known to the series and recorded, and the scheduler's memory stays bounded. Counted, never timed: a loaded computer
takes longer.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import zmq

import afspm
from afspm.storage.memory import Memory
from benchmarks.crashes import CrashWatch
from benchmarks.processes import PORTS

EXPERIMENT = """
scan_size = ["2 um", "2 um"]

[clock]
speed = 300.0

[security]
insecure = true

[microscope]
component = true
class = "Simulator"
surface = {{ kind = "stamper" }}
initial = {{ scan-speed = "8 um/s" }}

[scheduler]
component = true
class = "Scheduler"
pubsubcache = "{address}"

[series]
component = true
class = "ScanSeries"
size = "scan_size"
pixels = [256, 256]
scans = {scans}
end_when_done = true

[chatterbox]
component = true
class = "chatterbox.Chatterbox"

[dashboard]
component = true
class = "Dashboard"
port = {port}
"""
CHATTERBOX = """
from afspm.client.component import Component


class Chatterbox(Component):
    period_s = 0.1
    period_time = "real"

    def on_tick(self):
        for number in range(3):
            self.log.info("line %d", number)
"""
VIEWERS = 20
CROWDS = 2
STALLED_S = 180.0
"""Real time without a new scan after which the run counts as standing still: 60 times a scan on a loaded computer."""
MOST_MB = 180.0
"""Most memory of the scheduler: 112 MB in 10 crowds. Before sockets shared their replays it was 213 MB in 15 crowds."""
QUEUE_OF_DEAF = 10


class Crowd(threading.Thread):
    """Plain SUB sockets that all join, stay, and leave, again and again."""

    def __init__(self, address: str, count: int, half_round_s: float) -> None:
        super().__init__(daemon=True)
        self._address, self._count, self._half_round_s = address, count, half_round_s
        self._over = threading.Event()
        self.rounds = self.received = self.distinct = self.most = 0

    def run(self) -> None:
        while not self._over.is_set():
            self._round()
            self._over.wait(self._half_round_s)

    def _round(self) -> None:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        context.set(zmq.MAX_SOCKETS, 2 * self._count + 10)
        poller, received, distinct = zmq.Poller(), dict[object, int](), set[bytes]()
        for number in range(self._count):
            socket = context.socket(zmq.SUB)
            socket.setsockopt(zmq.LINGER, 0)
            if is_deaf := number % 4 == 0:
                socket.setsockopt(zmq.RCVHWM, QUEUE_OF_DEAF)
            socket.subscribe(b"")
            socket.connect(self._address)
            if not is_deaf:
                poller.register(socket, zmq.POLLIN)
                received[socket] = 0
        until_s = time.monotonic() + self._half_round_s
        while time.monotonic() < until_s and not self._over.is_set():
            for ready, _ in poller.poll(200):
                with contextlib.suppress(zmq.Again):
                    while frames := ready.recv_multipart(zmq.NOBLOCK):
                        received[ready] += 1
                        distinct.add(frames[-1])
        self.rounds += 1
        self.received += sum(received.values())
        self.distinct += len(distinct)
        self.most = max(self.most, *received.values())
        context.destroy(linger=0)

    def close(self) -> None:
        self._over.set()
        self.join()


@contextlib.contextmanager
def _viewers(url: str) -> Iterator[None]:
    # on a loaded computer some see their first picture late, or never: they are load, and not judged
    command = (sys.executable, "-m", "benchmarks.viewers", url, str(VIEWERS))
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            yield
        finally:
            process.kill()


class Attacked:
    """One run under attack."""

    def __init__(self, folder: Path, scans: int, subscribers: int, half_round_s: float) -> None:
        self._folder, self._scans, self._subscribers, self._half_round_s = folder, scans, subscribers, half_round_s
        self._crashes = CrashWatch()
        self._address, self._port = PORTS.address(), PORTS.take()
        self._pids: dict[str, int] = {}
        self._last_scan_s = time.monotonic()
        self._is_open = threading.Event()
        self.most_mb = 0.0

    def run(self) -> list[str]:
        """Run to the end, and return the faults found."""
        given = {"address": self._address, "port": self._port, "scans": self._scans}
        (self._folder / "experiment.toml").write_text(EXPERIMENT.format(**given), encoding="utf-8")
        (self._folder / "chatterbox.py").write_text(CHATTERBOX, encoding="utf-8")
        process = subprocess.Popen(
            [sys.executable, "-m", "afspm", "run", "experiment.toml", "--verbose", "--no-report"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=self._folder,
        )
        reader = threading.Thread(target=self._read, args=(process,), daemon=True)
        reader.start()
        try:
            wrong = self._attack(process)
        finally:
            process.terminate()
            process.wait()
            reader.join()
        return [*(wrong or self._wrong_with_record()), *self._crashes.in_logs(self._folder)]

    def _attack(self, process: subprocess.Popen[str]) -> list[str]:
        self._is_open.wait(STALLED_S)
        crowds = [Crowd(self._address, self._subscribers // CROWDS, self._half_round_s) for _ in range(CROWDS)]
        for crowd in crowds:
            crowd.start()
        try:
            with _viewers(f"http://127.0.0.1:{self._port}"):
                while process.poll() is None:
                    self.most_mb = max(self.most_mb, self._memory_mb())
                    if time.monotonic() - self._last_scan_s > STALLED_S:
                        return [f"no scan within {STALLED_S:g} s: it stands still"]
                    time.sleep(0.5)
        finally:
            for crowd in crowds:
                crowd.close()
        for crowd in crowds:
            print(
                f"{crowd.rounds} crowds of {self._subscribers // CROWDS} got {crowd.received} packets "
                f"({crowd.distinct} different ones), one of them {crowd.most}"
            )
        print(f"the scheduler took up to {self.most_mb:.0f} MB")
        wrong = [] if process.returncode == 0 else [f"exit code {process.returncode}"]
        if self.most_mb > MOST_MB:
            wrong.append(f"the scheduler grew to {self.most_mb:.0f} MB, over {MOST_MB:g}")
        return wrong

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout as pipe, (self._folder / "told.txt").open("w", encoding="utf-8") as told:
            for line in pipe:
                if started := re.search(r" (\w+) .*started, process (\d+)", line):
                    self._pids[started[1]] = int(started[2])
                if re.search(r" series .*scan \d+ of", line):
                    self._last_scan_s = time.monotonic()
                if "the dashboard is at" in line:
                    self._is_open.set()
                if " chatterbox " not in line:
                    told.write(line)
        self._is_open.set()

    def _memory_mb(self) -> float:
        # resident pages (Linux); nothing where the process or /proc is not there
        with contextlib.suppress(OSError, KeyError):
            pages = int(Path(f"/proc/{self._pids['scheduler']}/statm").read_text().split()[1])
            return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        return 0.0

    def _wrong_with_record(self) -> Iterator[str]:
        folder = (self._folder / "runs" / "latest").resolve()
        run = afspm.open_run(folder)
        done = Memory(folder / "state" / "series.json").get("done")
        if not self._scans == len(run.scans) == done:
            yield f"of {self._scans} scans {len(run.scans)} are recorded, and the series knows {done}"


def main() -> int:
    """Attack a run; return exit code 1 after a fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--scans", type=int, default=40)
    parser.add_argument("--subscribers", type=int, default=200)
    parser.add_argument("--half-round", type=float, default=15.0, metavar="S", help="time that each crowd stays")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="crowd-"))
    wrong = Attacked(folder, options.scans, options.subscribers, options.half_round).run()
    if wrong:
        print(f"{'; '.join(wrong)} ({folder})")
        return 1
    shutil.rmtree(folder)
    print(f"all {options.scans} scans are known to the series, and recorded")
    return 0


if __name__ == "__main__":
    sys.exit(main())
