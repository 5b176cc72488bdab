"""`python -m benchmarks.chaos [--nights N] [--seed S]`: nights in which processes are killed and frozen.

Each night is the sample `experiments/tip_repair`, shortened, as real processes. At moments drawn from a seed (also at
its start and its end) one, two or all of its processes are killed or frozen for a while. The night must still end by
itself, with every scan recorded once. The plan is printed with the faults found. The moment of a blow depends on the
computer, too, so an equal seed gives an equal plan, not an equal night.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
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

from afspm.basics.clock import ExperimentClock
from afspm.storage.memory import Memory
from benchmarks.crashes import CrashWatch

SAMPLE = Path(__file__).parents[1] / "experiments" / "tip_repair" / "experiment.toml"
OVER = """
[clock]
speed = {speed}

[microscope]
tip_changes = {{ schedule = [[2700, "double"]], pulse_cures = 0.6 }}

[series]
duration = "{minutes} min"

# a component that is frozen and killed misses what comes meanwhile
[cache]
history = {{ Scan2d = 100, ScopeStateMsg = 200 }}

[restart]
beat_period = 0.25
missed_beats = 6
budget = 1000
"""
MINUTES, PERIOD_MINUTES = 90, 10
SCANS = MINUTES // PERIOD_MINUTES + 1
SPEED = 480.0
DEADLINE_S = 240.0
ROLES = (
    "scheduler",
    "microscope",
    "series",
    "tip_classifier",
    "tip_corrector",
    "metadata",
    "night_picture",
    "recorder",
)
CLOCK = ExperimentClock.real()

MOMENTS = (
    # (a line of the log, how late after it at most, how often this moment is drawn)
    (r"processes, into", 3.0, 2),
    (r"processes, into", 25.0, 6),
    (r" series .*scan {scan} of \d+ at", 1.0, 6),
    (r"flagged tip-shape-changed", 1.5, 3),
    (r"tip_corrector is in control", 1.0, 3),
    (r"; restarting", 0.6, 3),
    (r" series .*scan (\d+) of \1 at", 0.3, 2),
    (r"all \d+ scans are taken", 0.1, 3),
    (r"ended the experiment", 0.6, 4),
)


@dataclass(frozen=True)
class Blow:
    """A blow to some processes: `late_s` after the first log line `after`.

    Attributes:
        frozen_s: how long they are frozen; 0.0: they are killed.
    """

    after: str
    late_s: float
    whom: tuple[str, ...]
    frozen_s: float


def blows(seed: int) -> list[Blow]:
    """Return the blows in the night of this seed."""
    chance = random.Random(seed)
    drawn = []
    for _ in range(chance.randint(1, 9)):
        pattern, at_most_s, _ = chance.choices(MOMENTS, [often for *_, often in MOMENTS])[0]
        after = pattern.format(scan=chance.randint(1, SCANS))
        whom = chance.sample(ROLES, chance.choice((1, 1, 1, 1, 2, 2, len(ROLES))))
        frozen_s = chance.choice((0.0, 0.0, 0.0, chance.uniform(0.01, 1.0), chance.uniform(1.0, 4.0)))
        drawn.append(Blow(after, round(chance.uniform(0.0, at_most_s), 3), tuple(whom), round(frozen_s, 3)))
    return drawn


@dataclass
class Night:
    """One run of the sample, with its blows."""

    folder: Path
    plan: list[Blow]
    lines: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.fell = 0
        self._pids: dict[str, int] = {}
        self._due: list[tuple[float, Blow]] = []
        self._thaw: list[tuple[float, int]] = []
        self._waiting = list(self.plan)
        self._incoming: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def run(self) -> list[str]:
        """Run the night and return the faults found."""
        crashes = CrashWatch()
        over = self.folder / "over.toml"
        over.write_text(OVER.format(speed=SPEED, minutes=MINUTES), encoding="utf-8")
        command = (sys.executable, "-m", "afspm", "run", str(SAMPLE), str(over), "--verbose")
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True, cwd=self.folder
        )
        threading.Thread(target=self._read, args=(process,), daemon=True).start()
        try:
            ended = self._strike_until_the_end()
            code = process.wait(DEADLINE_S) if ended else None
        finally:
            process.kill()
            process.wait()
            self._melt()
        if code is None:
            return [f"it did not end within {DEADLINE_S:g} s"]
        wrong = [] if code == 0 else [f"exit code {code}"]
        name = (self.folder / "runs" / "latest").resolve().name
        return [*wrong, *found_wrong(self.folder / "runs" / name), *crashes.in_logs(self.folder)]

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        with process.stdout as pipe:
            for line in pipe:
                self._incoming.put(line.decode(errors="replace").rstrip())
        self._incoming.put(None)

    def _strike_until_the_end(self) -> bool:
        # True once the run has ended, False after a time limit
        deadline_s = CLOCK.monotonic_s() + DEADLINE_S
        while (now_s := CLOCK.monotonic_s()) < deadline_s:
            soonest_s = min([deadline_s, *(at_s for at_s, _ in (*self._due, *self._thaw))])
            try:
                line = self._incoming.get(timeout=max(0.0, soonest_s - now_s))
            except queue.Empty:
                self._strike(CLOCK.monotonic_s())
                continue
            if line is None:
                return True
            self._hear(line, CLOCK.monotonic_s())
        return False

    def _hear(self, line: str, now_s: float) -> None:
        self.lines.append(line)
        if started := re.search(r" (\w+) .*started, process (\d+)", line):
            self._pids[started[1]] = int(started[2])
        for blow in [blow for blow in self._waiting if re.search(blow.after, line)]:
            self._waiting.remove(blow)
            self._due.append((now_s + blow.late_s, blow))
        self._strike(now_s)

    def _strike(self, now_s: float) -> None:
        for due in [due for due in self._due if due[0] <= now_s]:
            self._due.remove(due)
            self.fell += 1
            blow = due[1]
            self.lines.append(f"{CLOCK.now_s():.3f} --- {blow}")
            for name in blow.whom:
                self._signal(name, blow.frozen_s, now_s)
        for thaw in [thaw for thaw in self._thaw if thaw[0] <= now_s]:
            self._thaw.remove(thaw)
            _send(thaw[1], signal.SIGCONT)

    def _signal(self, name: str, frozen_s: float, now_s: float) -> None:
        pid = self._pids.get(name)
        if pid is None:
            return
        if not frozen_s:
            _send(pid, signal.SIGKILL)
        elif _send(pid, signal.SIGSTOP):
            self._thaw.append((now_s + frozen_s, pid))

    def _melt(self) -> None:
        for _, pid in self._thaw:
            _send(pid, signal.SIGCONT)


def _send(pid: int, number: signal.Signals) -> bool:
    # False: the process is gone, or its number belongs to another program by now
    with contextlib.suppress(OSError):
        if b"afspm" in Path(f"/proc/{pid}/cmdline").read_bytes():
            os.kill(pid, number)
            return True
    return False


def found_wrong(folder: Path) -> Iterator[str]:
    """Yield the faults in the folder of a run that has ended."""
    with (folder / "metadata.csv").open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["measurement"] == "scan"]
    several = {key: n for key, n in Counter((row["filename"], row["channel"]) for row in rows).items() if n > 1}
    if several:
        yield f"rows more than once: {several}"
    channels = Counter(row["channel"] for row in rows)
    if len(set(channels.values())) != 1:
        yield f"not every channel is in the table as often: {dict(channels)}"
    if len(set(Counter(row["time"] for row in rows).values())) != 1:
        yield "a scan has fewer rows than another"
    saved = Counter(file.name for file in (folder / "scans").glob("scan-*.nc"))
    listed = Counter(Path(row["filename"]).name for row in rows if row["channel"] == "Height")
    if saved != listed:
        yield f"saved and not in the table: {dict(saved - listed)}; the other way round: {dict(listed - saved)}"
    yield from _wrong_with_series(folder, [row for row in rows if row["channel"] == "Height"])
    control = Memory(folder / "state" / "scheduler.json")["control"]
    if control.get("problems") or control.get("flags"):
        yield f"problems are left: {control}"
    if not (folder / "night.png").is_file():
        yield "the night is not drawn"
    yield from _wrong_with_picture(folder, len(listed))


def _wrong_with_series(folder: Path, heights: list[dict[str, str]]) -> Iterator[str]:
    state = Memory(folder / "state" / "series.json")
    # where the computer takes longer than a period for the first round, some are left out, and the series says so
    wanted = SCANS - (int(state.get("missed", 0)) if state.get("is_slow") else 0)
    if state.get("done") != wanted:
        yield f"the series has {state.get('done')} of {wanted} scans"
    # a last test scan, elsewhere, may be asked for before the corrector loses control and begin after
    surely = sum(row["in_control"] == "series" and float(row["center_y"]) == 0.0 for row in heights)
    # where the table was not being written when a scan began, it does not say who was in control
    perhaps = surely + sum(not row["in_control"] for row in heights)
    if not surely <= wanted <= perhaps:
        yield f"{surely} to {perhaps} scans of the series in the table instead of {wanted}"
    log = (folder / "log.txt").read_text(encoding="utf-8")
    told = re.findall(r" series +scan (\d+) of \d+ at (\S+ \S+) UTC", log)
    times = {row["time"][:19].replace("T", " ") for row in heights}
    if len(set(told)) != len({number for number, _ in told}) or len({time for _, time in told}) != len(set(told)):
        yield f"a scan of the series stands for two: {told}"
    if missing := [(number, time) for number, time in told if time not in times]:
        yield f"scans that the series got and the table lacks: {missing}, it has {sorted(times)}"


def _wrong_with_picture(folder: Path, scans: int) -> Iterator[str]:
    record = (folder / "state" / "night_picture.night.jsonl").read_text(encoding="utf-8").splitlines()
    shown = sum(json.loads(line)["kind"] == "scan" for line in record)
    if shown != scans:
        yield f"the picture shows {shown} of {scans} scans"


@dataclass(frozen=True)
class Verdict:
    """The result of the night of a seed; `folder` is kept only after a fault."""

    seed: int
    took_s: float
    fell: int
    wrong: list[str]
    folder: Path


def nights(count: int, seed: int) -> Iterator[Verdict]:
    """Run `count` nights, with `seed` and the seeds after it."""
    for number in range(seed, seed + count):
        folder = Path(tempfile.mkdtemp(prefix=f"chaos-{number}-"))
        night = Night(folder, blows(number))
        began_s = CLOCK.monotonic_s()
        wrong = night.run()
        (folder / "told.txt").write_text("\n".join(night.lines), encoding="utf-8")
        yield Verdict(number, CLOCK.monotonic_s() - began_s, night.fell, wrong, folder)
        if not wrong:
            shutil.rmtree(folder)


def main() -> int:
    """Run the nights; return exit code 1 after a fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--nights", type=int, default=20)
    parser.add_argument("--seed", type=int, default=random.randrange(10**6))
    options = parser.parse_args()
    bad = 0
    for night in nights(options.nights, options.seed):
        bad += bool(night.wrong)
        told = f"{'; '.join(night.wrong)} ({night.folder})" if night.wrong else "nothing wrong"
        print(f"seed {night.seed}: {night.took_s:.0f} s, {night.fell} blows: {told}", flush=True)
    print(f"{options.nights - bad} of {options.nights} nights ended complete")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
