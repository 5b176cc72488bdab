"""Shared by tests of whole experiments: `afspm run` as a process of its own, and its run folder."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from afspm_process import AfspmProcess
from systems import PATIENCE

import afspm

SPEED = 120.0 / PATIENCE
Run = Callable[..., "AfspmRun"]

EXPERIMENT = """
[clock]
speed = {speed}

[microscope]
component = true
class = "Simulator"
seed = 1
initial = {{ scan-speed = "2 um/s" }}

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [32, 32]
every = "1 min"
scans = {scans}

[witness]
component = true
class = "witness.Witness"
scans = {scans}

# scans come twice a second: a component that is being restarted misses more than the last of them
[cache]
history = {{ Scan2d = 100 }}
"""

WITNESS = '''
"""Writes down every scan that it gets, and ends the experiment when it has had all and the file `until` is there."""

import threading
from collections import Counter
from pathlib import Path

import psutil

from afspm.model import ScopeState
from afspm.client.component import Component
from afspm.components.planned_scans import ScanSeries


class LastingSeries(ScanSeries):
    """Takes scans until the file `enough` is there, and ends the experiment once the witness has them all."""

    def __init__(self, enough: str, **series):
        super().__init__(**series)
        self.enough = Path(enough)

    def _await(self, step, rhythm):
        is_begun = step.index in (0, self.memory.get("begun"))
        return (is_begun or not self.enough.exists()) and super()._await(step, rhythm)

    def run(self):
        super().run()
        taken = self.memory["done"]
        (self.run_dir / "taken.txt").write_text(str(taken))
        while min(self.witnessed().values(), default=0) < taken:
            self.scope.sleep(1.0)
        self.scope.end_experiment()

    def witnessed(self):
        file = self.run_dir / "witnessed.txt"
        return Counter(line.split("|")[0] for line in file.read_text().splitlines()) if file.exists() else Counter()


class Witness(Component):
    def __init__(self, scans: int, until: str = ""):
        self.scans = scans
        self.until = until
        self.seen = Counter()
        self.free = False

    def end_if_done(self):
        if self.free and self.seen and min(self.seen.values()) >= self.scans and Path(self.until).exists():
            self.scope.end_experiment()

    def on_scan(self, scan):
        self.seen[scan.channel] += 1
        with (self.run_dir / "witnessed.txt").open("a") as file:
            file.write(f"{scan.channel}|{scan.time_ns}|{scan.filename}\\n")

    def on_state(self, status):
        self.log.info("state %s", status.state.name)
        self.free = status.state is ScopeState.FREE
        self.end_if_done()

    def on_control(self, control_state):
        self.end_if_done()


class Finisher(Component):
    """Has something to finish at the end, which takes for ever in its first life."""

    def on_end(self):
        begun = self.run_dir / f"{self.name} finishes.txt"
        first = not begun.exists()
        begun.touch()
        self.log.info("finishing")
        if first:
            threading.Event().wait()
        (self.run_dir / f"{self.name} has finished.txt").touch()


class Late(Component):
    """Freezes over the last scan in its first life. The next takes longer to load than a scheduler waits for nobody."""

    def __init__(self, scans: int, begun: str):
        self.scans = scans
        self.seen = Counter()
        self.first = not Path(begun).exists()
        Path(begun).touch()
        if not self.first:
            threading.Event().wait(2.0)

    def on_scan(self, scan):
        self.seen[scan.channel] += 1
        if min(self.seen.values()) >= self.scans:
            if self.first:
                psutil.Process().suspend()
            (self.run_dir / f"{self.name} has them all.txt").touch()
'''


def lasting(folder: Path) -> str:
    """Return an overlay: the series takes scans until the file `enough` is in the folder.

    For tests in which something has to happen while the scans go on, however slow the computer is.
    """
    return f'[series]\nclass = "witness.LastingSeries"\nenough = {json.dumps(str(folder / "enough"))}\n'


class AfspmRun(AfspmProcess):
    """A running `afspm run`, and its run folder."""

    def facts(self) -> dict[str, Any]:
        facts: dict[str, Any] = json.loads((self.folder / "run.json").read_text(encoding="utf-8"))
        return facts

    def end_lasting(self) -> int:
        """Let the series of a `lasting` run end; return how many scans were taken, with those of a tip's repair."""
        (self.folder.parents[1] / "enough").touch()
        assert self.end() == 0, self.output
        with afspm.open_run(self.folder) as record:
            rows = record.scans.where(lambda row: not row.interrupted)
        of_series = [row for row in rows if row.holder != "tip_corrector"]
        assert len(of_series) == int((self.folder / "taken.txt").read_text()), self.output
        return len(rows)

    def witnessed(self) -> Counter[tuple[str, ...]]:
        """Return each (channel, time, file) that the witness received, with its number of times."""
        text = (self.folder / "witnessed.txt").read_text(encoding="utf-8")
        return Counter(tuple(line.split("|")) for line in text.splitlines())


def require_each_row_once(run: AfspmRun, scans: int) -> None:
    """Require one row of the table of measurements for each channel of each scan."""
    with (run.folder / "metadata.csv").open(encoding="utf-8", newline="") as file:
        measured = [row for row in csv.DictReader(file) if row["measurement"] != "note"]
    rows = Counter((row["channel"], row["time"]) for row in measured)
    assert set(rows.values()) == {1}, rows
    assert set(Counter(channel for channel, _ in rows).values()) == {scans}, rows


def require_each_once(run: AfspmRun, scans: int) -> None:
    """Require that every requested scan was measured, saved, and received by a subscriber once."""
    saved = sorted(file.name for file in (run.folder / "scans").glob("scan-*.nc"))
    seen = run.witnessed()
    channels = {channel for channel, _, _ in seen}
    assert channels
    assert set(seen.values()) == {1}, f"seen again: {[key for key, n in seen.items() if n > 1]}\n{run.output}"
    for channel in channels:
        assert len([key for key in seen if key[0] == channel]) == scans, f"{channel}: {seen}\n{run.output}"
    assert len(saved) == scans, f"{saved}\n{run.output}"
    require_recorded_once(run.folder, channels, saved, run.output)


def require_recorded_once(folder: Path, channels: set[str], saved: list[str], told: str = "") -> None:
    """Require every scan in the record once, with all its channels and one file."""
    with afspm.open_run(folder) as record:
        rows = record.scans.where(lambda row: not row.interrupted)
        assert [Path(row.filename).name for row in rows] == saved, told
        assert {tuple(sorted(channel for channel, _ in row.channels)) for row in rows} == {tuple(sorted(channels))}, (
            told
        )
        files = sorted(file.relative_to(folder).as_posix() for file in (folder / "scans").glob("*.h5*"))
        assert sorted(row.file for row in record.scans if row.file) == files, told
        assert all(set(record.scan(row)) == channels for row in rows), told
