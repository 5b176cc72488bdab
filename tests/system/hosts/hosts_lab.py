"""An experiment on four hosts, with keys, and what must hold of it whatever becomes of the network: seen from outside.

    micro   the microscope's translator, which writes down what it is told to do, and when
    sched   the scheduler and the record
    left    a component that scans, with keys, below the middle; and a witness
    right   the same above the middle, beside a component that shows it

The monotonic clock is the same on all of them (they are one computer), so that what happened where can be put in order.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.system.hosts.faulty_network import FaultyNetwork
from tests.system.hosts.namespaced_host import Host, interrupt

import afspm
from afspm.transport.keys import generate

AFSPM = (sys.executable, "-P", "-m", "afspm")
DEADLINE_S = 90.0
HOSTS = {"micro": "10.77.0.1", "sched": "10.77.0.2", "left": "10.77.0.3", "right": "10.77.0.4"}
PARTS = {
    "micro": "microscope",
    "sched": "scheduler,recorder",
    "left": "left,left_witness",
    "right": "right,right_witness",
}
TILERS = ("left", "right")
PEOPLE = ("supervisor", "terminal", "dashboard")

EXPERIMENT = """
name = "hosts"
publish_url = "tcp://sched:29001"
router_url = "tcp://sched:29002"

[microscope]
component = true
class = "apparatus.Recorded"
publisher = "tcp://micro:29003"
control_server = "tcp://micro:29004"
surface = "flat"
live_lines_s = "{lines}"
initial = {{ scan-speed = "{speed}", move-speed = "100 um/s" }}

[scheduler]
component = true
class = "Scheduler"
pubsubcache = "publish_url"
router = "router_url"

[left]
component = true
class = "apparatus.Tiles"
y = "-2 um"
scans = {scans}
pixels = {pixels}

[right]
component = true
class = "apparatus.Tiles"
y = "2 um"
scans = {scans}
pixels = {pixels}

[left_witness]
component = true
class = "apparatus.Witness"

[right_witness]
component = true
class = "apparatus.Witness"

[cache]
history = {{ Scan2d = {kept}, ScopeStateMsg = 200 }}

[restart]
budget = 1000

[security]
keys = "keys"
"""

PAGE = """
[dashboard]
component = true
class = "Dashboard"
port = 8080
"""

APPARATUS = '''
"""What the hosts run: each writes down what it does or sees, with the monotonic time of the computer."""

import time
from pathlib import Path

from afspm import Component, Region
from afspm.simulation.simulator import Simulator
from afspm.model import names
from afspm.translator.driver_base import action
from afspm.basics.units import Length


def note(file, *said):
    with open(file, "a") as log:
        log.write(" ".join(map(str, (time.monotonic(), *said))) + "\\n")


class Recorded(Simulator):
    def set(self, values):
        super().set(values)
        note("commands.txt", "set", self.memory["values"][names.SCAN_TOP_LEFT_Y])

    @action(names.START_SCAN)
    def start_scan(self):
        Simulator.start_scan(self)
        note("commands.txt", "start", self.memory["values"][names.SCAN_TOP_LEFT_Y])


class Tiles(Component):
    def __init__(self, y: Length, scans: int, pixels: int):
        self.y_m, self.scans, self.pixels = y, scans, pixels

    def run(self):
        for i in range(self.scans):
            if Path("enough").exists():
                break
            region = Region((i % 5 * 1e-6, self.y_m), (1e-6, 1e-6))
            with self.scope.control():
                self.scope.scan(region, shape=(self.pixels, self.pixels), key=f"tile-{i}")
            self.scope.forget(f"tile-{i}") if self.pixels > 1000 else None
            note(f"{self.name}.txt", "tile", i)
            self.scope.progress(i + 1, self.scans)
        note(f"{self.name}.txt", "done")


class Witness(Component):
    def on_scan(self, scan):
        note(f"{self.name}.txt", scan.channel.replace(" ", "_"), scan.time_ns)
'''


@dataclass
class Part:
    """A part of the experiment on one host: its `afspm run`, and what that says."""

    host: Host
    only: str
    lines: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.start()

    def start(self, *more: str) -> None:
        """Start it, for the first time or again."""
        which = more or ("experiment.toml", "--only", self.only)
        self.process = self.host.popen([*AFSPM, "run", *which, "--no-report"])
        self._reader = threading.Thread(target=self._read, args=(self.process,), daemon=True)
        self._reader.start()

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        with process.stdout as pipe:
            for line in pipe:
                self.lines.append(f"{time.monotonic():.2f} {line.decode(errors='replace').rstrip()}")

    @property
    def folder(self) -> Path:
        """The newest run's."""
        runs = self.host.folder / "runs"
        return (runs / "latest").resolve()

    def end(self) -> int:
        """Wait until it has ended; returns its exit code."""
        code = self.process.wait(DEADLINE_S)
        self._reader.join()
        return code


class HostsLab:
    """Four hosts, the network between them, and the experiment that they run.

    Args:
        folder: a folder for each host is made there.
        clocks_ahead_s: by how much the clocks of hosts are ahead.
        page: a dashboard runs on `right`.
        left: what runs on `left`.
        lines: how often rows of a running scan are published; "0 s": they are not.
    """

    def __init__(
        self,
        folder: Path,
        *,
        scans: int = 4,
        pixels: int = 16,
        speed: str = "100 um/s",
        kept: int = 200,
        clocks_ahead_s: dict[str, float] | None = None,
        page: bool = False,
        left: str = PARTS["left"],
        lines: str = "0.5 s",
    ) -> None:
        self.scans, self.folder = scans, folder
        self.network = FaultyNetwork()
        self.parts: dict[str, Part] = {}
        self.hosts: dict[str, Host] = {}
        self.known = dict(HOSTS)
        self._only = {**PARTS, "left": left, "right": PARTS["right"] + (",dashboard" if page else "")}
        _make_keys(folder / "keys")
        text = EXPERIMENT.format(scans=scans, pixels=pixels, speed=speed, kept=kept, lines=lines) + (
            PAGE if page else ""
        )
        for name in HOSTS:
            ahead_s = (clocks_ahead_s or {}).get(name, 0.0)
            self.hosts[name] = Host(self.network, name, folder / name, self.known, clock_ahead_s=ahead_s)
            (folder / name / "experiment.toml").write_text(text, encoding="utf-8")
            (folder / name / "apparatus.py").write_text(APPARATUS, encoding="utf-8")
            _hand_out(folder / "keys", folder / name / "keys", [*PARTS[name].split(","), *PEOPLE])

    def start(self, *names: str) -> None:
        """Start the parts of these hosts; of all, where none is named."""
        for name in names or HOSTS:
            self.parts[name] = Part(self.hosts[name], self._only[name])

    def wait(self, condition: Callable[[], bool], what: str, within_s: float = DEADLINE_S) -> float:
        """Wait until something holds; returns how long that took, s."""
        began_s = time.monotonic()
        tick = threading.Event()
        while not condition():
            assert time.monotonic() - began_s < within_s, f"not within {within_s:g} s: {what}\n{self.output}"
            tick.wait(0.05)
        return time.monotonic() - began_s

    def pass_time(self, seconds: float) -> None:
        """Leave things as they are for so long; what ends early says so."""
        began_s = time.monotonic()
        self.wait(lambda: time.monotonic() - began_s >= seconds, "time", seconds + 1.0)
        assert all(part.process.poll() is None for part in self.parts.values()), self.output

    def page(self) -> str:
        """Return what the dashboard serves on its host; empty while it does not."""
        program = "import urllib.request as r; print(r.urlopen('http://127.0.0.1:8080/').read().decode())"
        return self.hosts["right"].run("python3", "-c", program).stdout

    def tiles(self, name: str) -> int:
        """Return how many scans a component has got, as it says itself."""
        return len({said[1] for _, said in self.noted(name, f"{name}.txt") if said[0] == "tile"})

    def noted(self, host: str, file: str) -> list[tuple[float, list[str]]]:
        """Return what was written down on a host: the monotonic time, and the words."""
        found = list((self.folder / host).rglob(file))
        lines = [line.split() for path in found for line in path.read_text(encoding="utf-8").splitlines()]
        return sorted((float(time_s), said) for time_s, *said in lines)

    def enough(self, *names: str) -> None:
        """Let these components, or both, take no more scans than those that they have begun."""
        for name in names or TILERS:
            (self.folder / name / "enough").touch()

    def is_done(self, name: str) -> bool:
        """Return whether a component has all the scans that it wanted."""
        return any(said[0] == "done" for _, said in self.noted(name, f"{name}.txt"))

    @property
    def all_done(self) -> bool:
        """True once both components have all their scans, and both witnesses have heard of each."""
        taken = sum(map(self.tiles, TILERS))
        return all(map(self.is_done, TILERS)) and all(
            self.witnessed(name) == taken for name in TILERS if f"{name}_witness" in self._only[name]
        )

    def witnessed(self, host: str) -> int:
        """Return how many scans, interrupted ones left out, the witness of a host has heard of."""
        return len({said[1] for _, said in self.noted(host, f"{host}_witness.txt")})

    def readdress(self, name: str, address: str) -> None:
        """Give a host another address, which all are told by its name."""
        self.hosts[name].move(address)
        self.known[name] = address
        for host in self.hosts.values():
            host.resolve(self.known)

    def finish(self, within_s: float = DEADLINE_S) -> dict[str, float]:
        """Wait for everything, end the experiment, and see that all parts have ended well.

        Returns the largest memory that a process of each host had, MB.
        """
        self.wait(lambda: self.all_done, "all scans", within_s)
        peak_mb = {name: host.peak_mb() for name, host in self.hosts.items()}
        told = self.hosts["sched"].run(*AFSPM, "end", "--yes")
        assert told.returncode == 0, f"{told}\n{self.output}"
        codes = {name: part.end() for name, part in self.parts.items()}
        assert set(codes.values()) == {0}, f"{codes}\n{self.output}"
        return peak_mb

    @property
    def output(self) -> str:
        """What all parts have said."""
        return "\n".join(f"{name}: {line}" for name, part in self.parts.items() for line in part.lines)

    def wrong(self) -> Iterator[str]:
        """Yield what should not be so, once it has ended."""
        folder = self.parts["sched"].folder
        with afspm.open_run(folder) as run:
            whole = [row for row in run.scans if not row.interrupted and row.region is not None]
            keys = Counter(f"{_tiler(row.region.center_m[1])}/{row.key}" for row in whole if row.region is not None)
            wanted = {f"{name}/tile-{i}" for name in TILERS for i in range(self.tiles(name))}
            if set(keys) != wanted or set(keys.values()) != {1}:
                yield f"the record has the keys {dict(keys)}"
            clock = json.loads((folder / "run.json").read_text(encoding="utf-8"))["clock"]
            zero_s = clock["origin_s"] - clock["wall_at_zero_s"]
            control = [(row.time_ns / 1e9 - clock["start_s"] + zero_s, row.state.holder or "") for row in run.control]
        yield from self._wrong_commands(control)

    def _wrong_commands(self, control: Sequence[tuple[float, str]]) -> Iterator[str]:
        """Compare what the microscope was told with who was in control when it was passed on."""
        for time_s, (what, y) in self.noted("micro", "commands.txt"):
            asked_by = _tiler(float(y))
            # what is on its way when control is lost still arrives: the scheduler waits for its answer
            holders = [who for since_s, who in control if since_s <= time_s + SLACK_S]
            recent = [who for since_s, who in control if time_s - SLACK_S <= since_s <= time_s + SLACK_S]
            if what == "start" and asked_by not in {*holders[-1:], *holders[-1 - len(recent) : -1]}:
                yield f"{time_s:.2f} s: a scan of {asked_by} was started while {holders[-1:]} was in control"

    def close(self) -> None:
        """End everything."""
        for part in self.parts.values():
            if part.process.poll() is None:
                interrupt(part.process)
        for host in self.hosts.values():
            host.lose_power()
        self.network.close()
        for part in self.parts.values():
            part.end()


SLACK_S = 0.3
"""So near a change of control, commands of both holders may reach the microscope: they were on their way."""


def _tiler(y_m: float) -> str:
    """Return who scans there."""
    return TILERS[y_m > 0.0]


def _make_keys(folder: Path) -> None:
    generate(folder, [name for part in PARTS.values() for name in part.split(",")] + [*PEOPLE])


def _hand_out(made: Path, folder: Path, names: Sequence[str]) -> None:
    shutil.copytree(made / "public", folder / "public")
    (folder / "private").mkdir(mode=0o700)
    for name in names:
        shutil.copy2(made / "private" / f"{name}.key_secret", folder / "private")
