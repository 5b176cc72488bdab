"""Recordings of the real programs, replayed to the driver in this process with their own clock."""

from __future__ import annotations

import ast
import bisect
import itertools
import json
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_clock import FakeClock
from tests.plugins.gxsm.gxsm_bench import Bench
from tests.plugins.gxsm.raw_clients import client

from afspm.model import Scan, ScopeState, names
from afspm.plugins.gxsm import Gxsm
from afspm.plugins.gxsm.bridge_client import message, value_of
from afspm.translator.trace import TracedExchange, TracedFile, TraceLine, read_trace

TRACES = Path(__file__).parents[4] / "shared" / "data" / "gxsm" / "traces"
LOOK_S = 0.02
BEGAN_S = 1_764_000_000.0

pytestmark = pytest.mark.skipif(not TRACES.is_dir(), reason="the recordings of the real programs are not here")


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


def played(trace: str, folder: Path, **made_up: Callable[[float], Any]) -> tuple[Gxsm, RecordedGxsm, FakeClock]:
    """Connect a driver to a recorded GXSM."""
    clock = FakeClock(BEGAN_S)
    link = RecordedGxsm(read_trace(TRACES / f"{trace}.trace.jsonl"), clock, folder, made_up)
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


_CALL = re.compile(r"(\w+)\((.*)\)")
OTHERWISE = (
    "gets('',)", "gets('R',)",  # the first name belongs to another entry
    "get('RangeX',) after abc",  # a step of its converter, which is another one
    "y_current()",  # of a session with scans before
    "list_",  # those of its hardware
    "chfname(0,)", "chfname(100,)",  # where it saves
    "rtquery('",  # where the tip is
)  # fmt: skip


@pytest.mark.parametrize(("file", "kind"), [("cmp_real_3", {"version": 3}), ("cmp_real_4shm", {"transport": "shm"})])
def test_the_emulated_gxsm_answers_as_the_real_one(
    bench: Callable[..., Bench], file: str, kind: dict[str, Any]
) -> None:
    # Up to the first scan: values, refusals, and placeholders for missing values.
    gxsm = client(bench(card="simulator", reach_m=2e-7, **kind).address)
    for ref, value in (("RangeX", "400"), ("RangeY", "200"), ("PointsX", "16"), ("PointsY", "8")):
        gxsm.call("set", ref, value)
    told = [(question, real) for question, real, _ in json.loads((TRACES / f"{file}.json").read_text(encoding="utf-8"))]
    before = told[: [question for question, _ in told].index("startscan()")]
    differ = {}
    for question, real in before:
        match = _CALL.match(question)
        assert match
        try:
            ours = gxsm.call(match[1], *ast.literal_eval(f"({match[2]})"))
        except RuntimeError as error:
            ours = f"!{error}"
        if not question.startswith(OTHERWISE) and _compared(ours) != _compared(real):
            differ[question] = real, ours
    gxsm.close()
    assert not differ
    assert len(before) > 70


def _compared(value: Any) -> Any:
    # The texts of errors and uninitialised numbers may differ.
    if isinstance(value, str) and value.startswith("!"):
        return "!"
    return [0.0 if abs(one) < 1e-300 else one for one in value] if isinstance(value, list | tuple) else value


def test_a_scan_stopped_while_the_panel_repeats_is_not_published(tmp_path: Path) -> None:
    # In the recording it is stopped at row 28 of 60; the scan before it is lost, as Auto Save was off.
    driver, link, clock = played("gxsm4-shm-repeat-at-panel-stopped", tmp_path)
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


def test_repeated_scans_are_separated_by_their_lines_alone(tmp_path: Path) -> None:
    # The worst case: no poll falls between two scans, and the file name stays the same.
    scan_s = 0.66

    def line(at_s: float) -> int:
        return 59 if at_s < 4.05 else min(int((at_s - 4.05) % scan_s / scan_s * 60), 59 if at_s < 4.71 else 28)

    def bits(at_s: float) -> list[float]:
        return [3.0 if 4.03 <= at_s < 5.01 else 1.0, 0.0, 0.0]

    def name(_: float) -> str:
        return "./not-set155-M-Xp-ZSmTopo.nc"

    made_up = {"y_current": line, "rtquery": bits, "chfname 0": name}
    driver, link, clock = played("gxsm4-shm-repeat-at-panel-stopped", tmp_path, **made_up)
    states, scans = looked_at(driver, link, clock, 13.0)
    assert not scans
    assert states.count(ScopeState.INTERRUPTED) == 2


@pytest.mark.parametrize(
    ("trace", "channels"),
    [
        ("gxsm4-shm-two-scans", {"ZS-Topo"}),
        ("gxsm3-bridge-two-scans", {"Topo", "Topo Backward", "ADC0-ITunnel"}),
    ],
)
def test_scans_of_the_real_programs_are_published_with_their_channels(
    tmp_path: Path, trace: str, channels: set[str]
) -> None:
    driver, link, clock = played(trace, tmp_path)
    exchanges = [one for one in read_trace(TRACES / f"{trace}.trace.jsonl") if isinstance(one, TracedExchange)]
    starts_s = [one.at_s for one in exchanges if one.what == "startscan"]
    ends_s = [*starts_s[1:], starts_s[-1] + 8.0]
    for start_s, end_s in zip(starts_s, ends_s, strict=True):
        clock.t_s = BEGAN_S + start_s - LOOK_S
        driver.start_scan()
        states, scans = looked_at(driver, link, clock, end_s - 2 * LOOK_S)
        assert states == [ScopeState.SCANNING, ScopeState.FREE]
        assert {scan.channel for scan in scans} == channels
    assert names.START_SCAN in driver.own_actions()
