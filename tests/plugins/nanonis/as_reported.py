"""What others report of real instruments, one report after the other: is it noticed, and is it before the tip lands?

python -m tests.plugins.nanonis.as_reported     # the table: `afspm test-translator` and two scans for each report

*Noticed* is a refusal, or a warning, whose words name the fact. *Harmless*: both scans are complete, in the frame
that was set, and that what the report may spoil is as it should be.
"""

from __future__ import annotations

import argparse
import io
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

if __name__ == "__main__":
    _ROOT = Path(__file__).parents[3]
    sys.path[:0] = [str(_ROOT), str(_ROOT / "tests" / "support"), str(_ROOT / "tests" / "plugins")]

import numpy as np
from tests.plugins.nanonis.nanonis_bench import Bench, Emulated
from tests.plugins.vendor_bench import TURNED, Peer, ready, scans

from afspm.model import ControlRequest, Region, Response, Scan, ScanParameters, ScopeState, Spectrum, names
from afspm.plugins.nanonis.emulator import NanonisEmulator, as_reported

SHAPE: Final = (12, 32)
SPEED: Final = 10.0
_RANGE_M: Final = 2e-6
_BEYOND: Final = Region((0.9e-6, 0.0), (400e-9, 400e-9), 0.0)
KNOWN: Final = {**NanonisEmulator.reported, **NanonisEmulator.reported_of_others}


@dataclass(frozen=True)
class Fact:
    """What to try of a report, and the words by which it is noticed.

    Attributes:
        noticed: a regular expression for words of a refusal or a warning; "": it is harmless, and nothing is told.
        tries: acts after the scans; returns the answers.
        holds: whether the emulator is as it should be at the end.
        why: why it can't be noticed.
    """

    noticed: str = ""
    tries: Callable[[Peer], list[Response]] = lambda peer: []
    holds: Callable[[Emulated], bool] = lambda emulated: True
    why: str = ""


def _sets_beyond(peer: Peer) -> list[Response]:
    return [peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(_BEYOND, SHAPE, ""))]


def _shapes_and_scans(peer: Peer) -> list[Response]:
    shaped = peer.act(names.CRASH)
    started = peer.act_once_free(names.START_SCAN)
    peer.until(lambda one: isinstance(one, Scan))
    peer.until(ScopeState.FREE)
    return [shaped, started]


def _pulses(peer: Peer) -> list[Response]:
    assert peer.set(names.PULSE_DURATION, 10.0).ok
    return [peer.act(names.PULSE)]


def _stops(peer: Peer) -> list[Response]:
    assert peer.set(names.SCAN_SPEED, "20e-9").ok
    started = peer.act_once_free(names.START_SCAN)
    peer.until(ScopeState.SCANNING)
    stopped = peer.act(names.STOP_SCAN)
    peer.until(ScopeState.FREE)
    return [started, stopped]


def _sweeps_down(peer: Peer) -> list[Response]:
    return [peer.set(names.SPEC_Z_FROM, 1e-9), peer.set(names.SPEC_Z_TO, -0.2e-9)]


def _takes_curve(peer: Peer) -> list[Response]:
    points = peer.set(names.SPEC_POINTS, 33)
    started = peer.act_once_free(names.START_SPEC)
    peer.until(lambda one: isinstance(one, Spectrum))
    peer.until(ScopeState.FREE)
    return [points, started]


FACTS: Final[dict[str, Fact]] = {
    as_reported.ZEROS: Fact(),
    as_reported.OVER_RANGE: Fact("beyond the scanner", _sets_beyond),
    as_reported.CONTINUOUS: Fact(holds=lambda emulated: not emulated.software.scans.properties.continuous),
    as_reported.LATE_STATUS: Fact(),
    as_reported.OTHER_LAYOUT: Fact("is chosen in Nanonis' Scan Control, and can't be read"),
    as_reported.WEDGED_PORT: Fact(holds=lambda emulated: not emulated.wedged_ports),
    as_reported.CLOSED_MODULES: Fact("Tip ?Shaper", lambda peer: [peer.act(names.CRASH)]),
    as_reported.BLOCKING_PULSE: Fact(tries=_pulses),
    as_reported.SLOW_SHAPER: Fact(tries=_shapes_and_scans),
    as_reported.CODE_PAGE: Fact(
        holds=lambda emulated: emulated.software.scans.properties.comment == as_reported.COMMENT
    ),
    as_reported.QPLUS_NAMES: Fact(),
    as_reported.CURVE_LAYOUT: Fact("does not report whether it saves curves", _takes_curve),
    as_reported.CURVE_STATUS: Fact("BiasSpectr.StatusGet is not asked from now on", _takes_curve),
    as_reported.UNSAVED_CURVES: Fact(tries=_takes_curve),
    as_reported.FEW_PIXELS: Fact("scan-resolution-x|scan-size-x"),
    as_reported.UNKNOWN_STATUS: Fact("has the status 9, which no document names"),
    as_reported.DEAF_STOP: Fact("measures on 5 s after the stop", _stops),
    as_reported.OFFSET_IN_VOLTS: Fact(
        why="set and returned alike: only a picture shows it, and `afspm commission` asks a person to compare one"
    ),
    as_reported.ROUNDED_READING: Fact("scan-top-left"),
    as_reported.KEEPS_TIME: Fact(),
    as_reported.Z_SWEEP_TOWARDS: Fact("x-spec-z-to", _sweeps_down),
    as_reported.BACKWARD_BY_TIME: Fact(
        why="curves are saved: only data without a file is mirrored", tries=_takes_curve
    ),
    as_reported.COUNTER_CLOCKWISE: Fact(
        why="set and returned alike: only a picture shows it, and `afspm commission` asks a person to compare one"
    ),
}


@dataclass(frozen=True)
class Tried:
    """The outcome of two scans with a report.

    Attributes:
        noticed: a line of the log, or the reason of a refusal, with the words of the fact; empty: none.
        is_right: both scans are complete, in the frame that was set, and what the report may spoil holds.
    """

    noticed: str
    is_right: bool


def two_scans(report: str, folder: Path) -> Tried:
    """Take two scans, and carry out the acts of a report."""
    fact, refusals, found = FACTS[report], list[str](), list[Scan]()
    with ExitStack() as stack:
        emulator = {"as_reported": [report], "range_m": _RANGE_M, "port": 0, "ports": 4, "one_each": True}
        emulator |= {"feedback": {"mode": "amplitude", "setpoint": 0.7}} if report == as_reported.QPLUS_NAMES else {}
        made = Bench(folder, stack, SPEED, emulator)
        volts = {"zctrl-setpoint": {"unit": "V", "range": [0, 10]}} if report == as_reported.QPLUS_NAMES else {}
        host, _, ports = made.address.rpartition(":")
        address = f"{host}:{','.join(ports.split(',')[:3])}"
        peer = made.start(address=address, live_lines_s=0.5, parameters=volts, sensor="other", result_timeout_s=30.0)
        answers: list[Response] = []
        try:
            ready(peer, TURNED, SHAPE)
            for _ in range(2):
                answers.append(peer.act_once_free(names.START_SCAN))
                if answers[-1].ok:
                    found += scans(peer.until(lambda one: isinstance(one, Scan)))
                    found += scans(peer.until(ScopeState.FREE))
            answers += fact.tries(peer)
        except AssertionError as error:  # a step was refused, or never ended
            refusals.append(str(error))
        refusals += [answer.reason for answer in answers if not answer.ok]
        state: list[Any] = []
        made.at_panel(lambda emulated: state.extend((fact.holds(emulated), emulated.rig.setup.region)))
        lines = [line for line in made.log_text().splitlines() if line.startswith(("WARNING", "ERROR", "CRITICAL"))]
    noticed = next((one for one in (*refusals, *lines) if fact.noticed and re.search(fact.noticed, one)), "")
    is_there = len(state) > 1 and bool(np.allclose(state[1].center_m, TURNED.center_m, atol=5e-9))
    whole = bool(found) and all(np.isfinite(scan.values).all() for scan in found)
    roles = {scan.channel for scan in found}
    has_channels = report != as_reported.QPLUS_NAMES or any("OC_D1_Amplitude" in name for name in roles)
    return Tried(noticed, whole and is_there and bool(state[0]) and has_channels)


def before_the_tip(report: str, folder: Path) -> str:
    """Return the line by which `afspm test-translator` notices a report; empty: it does not."""
    from afspm.plugins import nanonis

    fact = FACTS[report]
    if not fact.noticed:
        return ""
    given = Path(nanonis.__file__).with_name("emulated.toml").read_text(encoding="utf-8")
    file = folder / "emulated.toml"
    text = given.replace("seed = 7\n", f'seed = 7\nas_reported = ["{report}"]\nrange_m = {_RANGE_M}\n')
    file.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "afspm", "test-translator", str(file), "--yes", "--runs", str(folder)]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", cwd=folder)
    lines = [
        line for line in (done.stdout + done.stderr).splitlines() if line.lstrip().startswith(("✗", "!", "WARN", "ERR"))
    ]
    for log in folder.rglob("log.txt"):
        logged = log.read_text(encoding="utf-8", errors="replace").splitlines()
        lines += [line for line in logged if re.search("WARNING|ERROR|CRITICAL", line)]
    return next((line.strip() for line in lines if re.search(fact.noticed, line)), "")


def _row(report: str) -> str:
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
        tried, before = two_scans(report, Path(first)), before_the_tip(report, Path(second))
    verdict = "harmless" if tried.is_right else f"NEITHER: {FACTS[report].why}" if FACTS[report].why else "NEITHER"
    words = before or tried.noticed
    noticed = f"{'x' if before else '-':^8}{'x' if tried.noticed else '-':^8}"
    return f"{report:18}{noticed}{'noticed' if words else verdict:10} {words[:110]}"


def _say(line: str) -> None:
    if (terminal := sys.__stdout__) is not None:
        terminal.write(f"{line}\n")
        terminal.flush()


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("reports", nargs="*", default=list(KNOWN))
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    _say(f"{'':18}{'before':^8}{'in two':^8}\n{'report':18}{'the tip':^8}{'scans':^8}")
    # each bench prints its translator's log at its end
    with redirect_stdout(io.StringIO()), ThreadPoolExecutor(given.jobs) as pool:
        rows = []
        for row in pool.map(_row, given.reports):
            _say(row)
            rows.append(row)
    return int(any("NEITHER " in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
