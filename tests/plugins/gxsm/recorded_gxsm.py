"""A recording of GXSM, real or written, replayed to the driver in this process with its own clock."""

from __future__ import annotations

import bisect
import itertools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fake_clock import FakeClock

from afspm.model import Scan, ScopeState
from afspm.plugins.gxsm import Gxsm
from afspm.plugins.gxsm.bridge_client import message, value_of
from afspm.plugins.gxsm.settings import SUBSCAN
from afspm.translator.trace import TracedExchange, TracedFile, TraceLine

LOOK_S = 0.02
BEGAN_S = 1_764_000_000.0


class RecordedGxsm:
    """A link that answers each call as the recorded GXSM did at this time, or next.

    Answers missing in the recording are functions of time (`made_up`).
    """

    def __init__(
        self, trace: list[TraceLine], clock: FakeClock, folder: Path, made_up: dict[str, Callable[[float], Any]]
    ) -> None:
        said = [one for one in trace if isinstance(one, TracedExchange) and one.asked is not None]
        bits = [(one.at_s, one.answered.startswith(b'{"value": [3.0')) for one in said if one.what == "rtquery"]
        changes = itertools.pairwise(bits)
        self._begins_s = [at_s for (_, was), (at_s, scans) in changes if scans and not was]
        self._answers: dict[bytes, list[tuple[float, bytes]]] = {}
        for one in said:
            self._answers.setdefault((one.asked or b"").strip(), []).append((one.at_s, one.answered))
        self._files = [one for one in trace if isinstance(one, TracedFile)]
        self._clock, self._folder, self._made_up = clock, folder, made_up
        self.called: list[tuple[Any, ...]] = []

    @property
    def at_s(self) -> float:
        return self._clock.t_s - BEGAN_S

    def call(self, method: str, *arguments: Any) -> Any:
        self.called.append((method, *arguments))
        if method == "action":
            return 0  # to any, the real ones answer the same
        if method in self._made_up:
            return self._made_up[method](self.at_s)
        if method == "chfname" and "chfname 0" in self._made_up and arguments == (0,):
            return self._made_up["chfname 0"](self.at_s)
        if method == "get_slice":  # recorded with the time element 0, as there was no movie
            channel, value, _, row, count = arguments
            arguments = (channel, value, 0, row, count)
            if message(method, *arguments).strip() not in self._answers:  # a row that the recording was not asked for
                arguments = (channel, value, 0, 0, count)
        if method == "get" and arguments[0] in SUBSCAN:
            return 0.0  # not recorded: it was off
        answers = self._answers[message(method, *arguments).strip()]
        index = bisect.bisect(answers, (self.at_s, b"\xff"))
        if index and (index == len(answers) or self._scan_at(answers[index - 1][0]) == self._scan_at(self.at_s)):
            index -= 1
        return value_of(answers[index][1])

    def _scan_at(self, at_s: float) -> int:
        # An answer belongs to the last started scan.
        return bisect.bisect(self._begins_s, at_s)

    def working_folder(self) -> Path:
        return self._folder

    def close(self) -> None: ...

    def write_files(self) -> None:
        for one in [one for one in self._files if one.at_s <= self.at_s]:
            self._files.remove(one)
            (self._folder / one.file).write_bytes(one.content)


def played(
    trace: list[TraceLine], folder: Path, **made_up: Callable[[float], Any]
) -> tuple[Gxsm, RecordedGxsm, FakeClock]:
    """Connect a driver to a recorded GXSM."""
    clock = FakeClock(BEGAN_S)
    link = RecordedGxsm(trace, clock, folder, made_up)
    driver = Gxsm()
    driver.clock, driver.log, driver.run_dir, driver.memory = clock, logging.getLogger("gxsm"), folder, {}
    driver._open = lambda *_, **__: link  # type: ignore[assignment]
    driver.connect()
    return driver, link, clock


def looked_at(
    driver: Gxsm, link: RecordedGxsm, clock: FakeClock, until_s: float
) -> tuple[list[ScopeState], list[Scan]]:
    """Return the driver's states, poll by poll, and the scans."""
    states: list[ScopeState] = []
    scans: list[Scan] = []
    known: set[str] = set()
    while link.at_s < until_s:
        clock.t_s += LOOK_S
        link.write_files()
        state = driver.status().state
        results = [one for one in driver.results() if one not in known]
        known.update(results)
        scans += [scan for one in results for scan in driver.load(one) if isinstance(scan, Scan)]
        is_whole = driver.followed()
        if is_whole is not None:
            states += [ScopeState.FREE] if is_whole else [ScopeState.INTERRUPTED, ScopeState.FREE]
        if not states or states[-1] is not state:
            states.append(state)
    return states, scans


def publishes_no_stopped_scan(trace: list[TraceLine], folder: Path) -> None:
    """Check a recording of a scan that was stopped while the panel repeats: nothing of it is published."""
    driver, link, clock = played(trace, folder)
    states, scans = looked_at(driver, link, clock, 13.0)
    assert not scans
    assert states == [
        ScopeState.FREE,
        ScopeState.SCANNING,
        ScopeState.INTERRUPTED,
        ScopeState.FREE,
        ScopeState.SCANNING,
        ScopeState.INTERRUPTED,
        ScopeState.FREE,
    ]
    assert ("autosave",) not in link.called
    assert ("action", "CHECK-MainAutoSave") in link.called, "GXSM saves measurements from its panel"


def scanned_one_by_one(
    trace: list[TraceLine], folder: Path, last_s: float
) -> tuple[Gxsm, list[tuple[list[ScopeState], list[Scan]]]]:
    """Start each recorded scan when it was started; return the driver, and the states and channels of each scan."""
    driver, link, clock = played(trace, folder)
    exchanges = [one for one in trace if isinstance(one, TracedExchange)]
    starts_s = [one.at_s for one in exchanges if one.what == "startscan"]
    found = []
    for start_s, end_s in zip(starts_s, [*starts_s[1:], starts_s[-1] + last_s], strict=True):
        clock.t_s = BEGAN_S + start_s - LOOK_S
        driver.start_scan()
        found.append(looked_at(driver, link, clock, end_s - 2 * LOOK_S))
    return driver, found
