"""`python power_cut.py [--cuts N] [--seed S] [--killed]`: power cuts in the middle of an experiment.

A simulated experiment of scans, spectra and problems loses its power (every process is killed, at moments drawn from
a seed, and unsynced data are lost) and is resumed. A plain subscriber of version 1 records all publications; in the end
the record must contain all of them, bit by bit, except the last moment before each cut, and each measurement once.
With `--killed` only the processes are killed: then nothing may be missing.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import queue
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import afspm
from afspm import wire
from afspm.basics.clock import ExperimentClock
from afspm.client.connect import connect
from afspm.model import ControlMode, Packet, ScopeState
from afspm.storage.segment import SUFFIX
from afspm.wire import KILL, decode_packet

CLOCK = ExperimentClock.real()
DEADLINE_S = 480.0
LATEST_S = 30.0
"""A packet seen earlier before a cut must be recorded; later, if it was seen before the last sync of the log began. The
promise is a tenth of a second, but a sync copies whole files here, and the computer may be busy."""
LOSSY = Path(__file__).parents[2] / "support" / "lossy_disk"
LONGEST_LIFE_S = 2.5
"""From the first scan of a life to the cut; in every fourth life, from its first line."""
COMMAND = (sys.executable, "-m", "afspm", "run", "--no-report")

EXPERIMENT = """
[clock]
speed = 240.0

[microscope]
component = true
class = "Simulator"
seed = {seed}
initial = {{ scan-speed = "4 um/s" }}
live_lines_s = "5 s"

[scheduler]
component = true
class = "patient_scheduler.PatientScheduler"

[tireless]
component = true
class = "tireless.Tireless"

[metadata]
component = true
class = "Metadata"

[control]
solved_by_hand = ["thermal-drift"]
grace = "1 s"
"""
COMPONENT = '''
"""Measures for ever, each thing once, and has a problem now and then."""

import itertools

from afspm import Component, Region


class Tireless(Component):
    def run(self):
        self.scope.clear("thermal-drift")  # a cut between flag and clear leaves it standing, as it should
        for i in itertools.count(self.memory.get("done", 0)):
            region = Region((i % 5 * 1e-6, 0), (1e-6, 1e-6))
            scans = self.scope.scan(region, shape=(24, 24), key=f"scan-{i}")
            self.scope.note(f"number {i}", scan=scans)
            if i % 3 == 1:
                self.scope.spectrum((i % 5 * 1e-6, 0), key=f"spectrum-{i}")
            if i % 4 == 2:
                self.scope.flag("thermal-drift")
                self.scope.clear("thermal-drift")
            self.memory["done"] = i + 1
            self.memory.save()
'''


class Witness:
    """A plain subscriber, as of version 1, to one scheduler after the other."""

    def __init__(self) -> None:
        import zmq

        self.seen: dict[tuple[int, str], bytes] = {}
        self.seen_s: dict[tuple[int, str], float] = {}
        self.contradicted: list[tuple[int, str]] = []
        self._context: Any = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        # by the empty prefix a plain socket means what version 1 has
        for prefix in ("", "JournalEntries", "LogLines", "ProcessStates", "Progress", "Note"):
            self._socket.setsockopt(zmq.SUBSCRIBE, prefix.encode())
        self._socket.setsockopt(zmq.RCVHWM, 0)
        self._socket.setsockopt(zmq.RCVTIMEO, 20)
        self._address = ""
        self._killed = False
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._scanned = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def attend(self, address: str) -> None:
        """Subscribe to this scheduler from now on."""
        with self._lock:
            if self._address:
                self._socket.disconnect(self._address)
            self._socket.connect(address)
            self._address = address
            self._scanned.clear()

    def wait_for_scan(self) -> None:
        """Wait for a scan of the present scheduler."""
        assert self._scanned.wait(DEADLINE_S), "nothing is measured"

    def close(self) -> None:
        """Receive pending packets, and close."""
        self._over.set()
        self._thread.join()
        self._context.destroy(linger=0)

    def _listen(self) -> None:
        import zmq

        while True:
            with self._lock:
                try:
                    frames = self._socket.recv_multipart()
                except zmq.Again:
                    if self._over.is_set():
                        return
                    continue
            if frames == [KILL]:
                self._killed = True
            elif len(frames) == 3 and not self._killed:  # last words after the end are for nobody any more
                self._take(frames)

    def _take(self, frames: list[bytes]) -> None:
        packet = decode_packet(frames)
        key = (packet.time_ns or 0, packet.envelope)
        if packet.envelope.startswith("Scan2d") and key not in self.seen:
            self._scanned.set()
        self.seen_s.setdefault(key, CLOCK.monotonic_s())
        if self.seen.setdefault(key, frames[1]) != frames[1]:
            self.contradicted.append(key)


@dataclass
class Life:
    """One life of the run: `afspm run` with all its processes."""

    command: tuple[str, ...]
    folder: Path
    lossy: bool
    lines: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._incoming: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        lossy = {"LOSSY_FOLDER": str(self.folder / "runs")} if self.lossy else {}
        self.process = subprocess.Popen(
            self.command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=self.folder,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": str(LOSSY), **lossy},
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as pipe:
            for line in pipe:
                self._incoming.put(line.decode(errors="replace").rstrip())
        self._incoming.put(None)

    def wait_for(self, pattern: str, within_s: float = DEADLINE_S) -> str | None:
        """Return the next line with the pattern; None if the process ends, or on a timeout."""
        until_s = CLOCK.monotonic_s() + within_s
        with contextlib.suppress(queue.Empty):
            while (line := self._incoming.get(timeout=max(0.0, until_s - CLOCK.monotonic_s()))) is not None:
                self.lines.append(line)
                if re.search(pattern, line):
                    return line
        return None

    def cut(self) -> None:
        """Kill all processes at one moment."""
        tree = [self.process.pid, *_below(self.process.pid)]
        for sent in (signal.SIGSTOP, signal.SIGKILL):  # nobody sees another die
            for pid in tree:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, sent)
        self.process.wait()


def _below(pid: int) -> Iterator[int]:
    with contextlib.suppress(OSError):
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split():
            yield int(child)
            yield from _below(int(child))


@dataclass(frozen=True)
class Verdict:
    """The result: `wrong` lists the errors; `seen` is the number of packets received by the witness."""

    folder: Path
    cuts: int
    seen: int
    scans: int
    spectra: int
    wrong: list[str]


def power_cuts(folder: Path, cuts: int, seed: int, tell: Any = lambda text: None, *, lossy: bool = True) -> Verdict:
    """Start an experiment in a folder, cut and resume it `cuts` times, and end it.

    Args:
        lossy: unsynced data are lost with each cut.

    Raises:
        AssertionError: a life did not start, or the last did not end.
    """
    chance = random.Random(seed)
    (folder / "experiment.toml").write_text(EXPERIMENT.format(seed=seed), encoding="utf-8")
    (folder / "tireless.py").write_text(COMPONENT, encoding="utf-8")
    witness = Witness()
    lost_s: list[tuple[float, float]] = []
    since_s: float | None = None
    command: tuple[str, ...] = (*COMMAND, "experiment.toml")
    try:
        for number in range(cuts + 1):
            life = Life(command, folder, lossy)
            begun = life.wait_for("processes, into")
            assert begun is not None, "\n".join(life.lines)
            run = Path(begun.rpartition(", into ")[2])
            facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
            if since_s is not None:  # up to now it may receive packets that were under way at the cut
                lost_s.append((since_s, CLOCK.monotonic_s()))
            witness.attend(facts["processes"]["scheduler"]["publish"])
            command = (*COMMAND, "--resume", str(run))
            if number < cuts:
                if number % 4 != 3:
                    witness.wait_for_scan()
                life.wait_for("never said", chance.uniform(0.0, LONGEST_LIFE_S))
                life.cut()
                if lossy:
                    disk = shadow(folder / "runs")
                    since_s = max(disk.synced_s(SUFFIX), CLOCK.monotonic_s() - LATEST_S)
                    disk.restore()
                tell(f"cut {number + 1} of {cuts}")
            else:
                _end(life, run)
    finally:
        if life.process.poll() is None:
            life.cut()
        witness.close()
    return _verdict(run, witness, lost_s, cuts, most_lost=cuts if lossy else 0)


def shadow(folder: Path) -> Any:
    """Return the synced state of a folder that is written with LOSSY in PYTHONPATH."""
    spec = importlib.util.spec_from_file_location("lossy_disk", LOSSY / "sitecustomize.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Shadow(str(folder))


def _end(life: Life, run: Path) -> None:
    with connect(run, "outside") as scope:
        for _ in scope.events("Scan2d", timeout_s=DEADLINE_S):
            break
        # at rest, or what has just been measured is not published any more
        scope.set_mode(ControlMode.MANUAL)
        resting = scope.wait_until(
            lambda: scope.state in (ScopeState.FREE, ScopeState.INTERRUPTED), timeout_s=DEADLINE_S
        )
        assert resting, f"the microscope does not rest: {scope.state.name}"
        scope.end_experiment()
    life.wait_for("never said")
    assert life.process.wait(DEADLINE_S) == 0, "\n".join(life.lines)


def _verdict(run: Path, witness: Witness, lost_s: list[tuple[float, float]], cuts: int, *, most_lost: int) -> Verdict:
    with afspm.open_run(run) as record:
        wrong = list(_wrong(record, witness, lost_s, most_lost))
        return Verdict(run, cuts, len(witness.seen), len(record.scans), len(record.spectra), wrong)


def _flags(witness: Witness) -> Iterator[tuple[int, str]]:
    # the first packets of each new problem
    before: set[int] = set()
    for key in sorted(key for key in witness.seen if key[1] == "ControlState"):
        problems = set(wire.decode("ControlState", witness.seen[key]).problems)
        if problems - before:
            yield key
        before = problems


def _wrong(record: Any, witness: Witness, lost_s: list[tuple[float, float]], most_lost: int) -> Iterator[str]:
    # lost_s: intervals in which packets may be lost, one for each cut; most_lost: measured files that may be lost
    flags = set(_flags(witness))

    def may_be_lost(key: tuple[int, str]) -> bool:
        return key not in flags and any(first <= witness.seen_s[key] <= last for first, last in lost_s)

    if witness.contradicted:
        yield f"published twice at the same time, and not the same: {witness.contradicted[:3]}"
    recorded = {(packet.time_ns, packet.envelope): packet for packet in record.packets()}
    missing = [key for key in witness.seen if key not in recorded and not may_be_lost(key)]
    if missing:
        yield f"{len(missing)} packets were published and are not recorded: {sorted(missing)[:3]}"
    other = [key for key, payload in witness.seen.items() if key in recorded and not _same(recorded[key], payload)]
    if other:
        yield f"{len(other)} packets are recorded otherwise than they were published: {sorted(other)[:3]}"
    whole = [row for row in record.scans if not row.interrupted]
    saved = Counter(file.name for file in (record.folder / "scans").glob("scan-*.nc"))
    found = Counter(Path(row.filename).name for row in whole)
    if found - saved or (saved - found).total() > most_lost:
        yield f"scans recorded otherwise than measured: {found - saved} too often, {saved - found} missing"
    if len({row.channels for row in whole}) != 1:
        yield f"not every scan has all of its channels: {Counter(row.channels for row in whole)}"
    for row in (*record.scans, *record.spectra):
        file = record.folder / row.file if row.file else None
        if file and not (file.is_file() and file.stat().st_size):
            yield f"{row.file} is missing, or empty"
    files = {file.name for file in record.folder.glob("s*/*.h5*")}
    # a file is synced at once, its packets a moment later
    stray = files - {Path(row.file).name for row in (*record.scans, *record.spectra)}
    if len(stray) > most_lost:
        yield f"files that nobody knows of: {sorted(stray)[:3]}"
    log = (record.folder / "log.txt").read_text(encoding="utf-8")
    if bool(stray) != ("in no table of the record" in log):
        yield f"the log does not tell of the files that nobody knows of: {sorted(stray)}"
    curves = Counter(Path(row.filename).name for row in record.spectra)
    saved = Counter(file.name for file in (record.folder / "scans").glob("spectrum-*.nc"))
    if curves - saved or (saved - curves).total() > most_lost:
        yield "spectra recorded otherwise than measured"


def _same(packet: Packet, payload: bytes) -> bool:
    return bytes(packet.payload) == payload


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main() -> int:
    """Return the exit code: 1 if a publication was lost or duplicated."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cuts", type=int, default=100)
    parser.add_argument("--killed", action="store_true", help="what was not synced is not lost")
    parser.add_argument("--seed", type=int, default=random.randrange(10**6))
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="power-cut-"))
    verdict = power_cuts(folder, options.cuts, options.seed, _say, lossy=not options.killed)
    told = "; ".join(verdict.wrong) or "nothing is lost, nothing is there twice"
    _say(
        f"seed {options.seed}: {verdict.cuts} cuts, {verdict.seen} packets seen, {verdict.scans} scans and "
        f"{verdict.spectra} spectra: {told}"
    )
    if verdict.wrong:
        _say(f"it is kept in {folder}")
        return 1
    shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
