"""Recordings of the real programs, replayed to the driver, and their answers beside the emulator's."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from benchmarks.data_folder import DATA
from temporary_folder import use_temporary_folder
from tests.plugins.gxsm.gxsm_bench import Bench
from tests.plugins.gxsm.raw_clients import client
from tests.plugins.gxsm.recorded_gxsm import looked_at, played, publishes_no_stopped_scan, scanned_one_by_one
from tests.plugins.vendor_bench import benches

from afspm.model import ScopeState, names
from afspm.translator.trace import TraceLine, read_trace

TRACES = DATA / "gxsm" / "traces"


def recording(name: str) -> list[TraceLine]:
    return read_trace(TRACES / f"{name}.trace.jsonl")


_CALL = re.compile(r"(\w+)\((.*)\)")
OTHERWISE = (
    "gets('',)", "gets('R',)",  # the first name belongs to another entry
    "get('RangeX',) after abc",  # a step of its converter, which is another one
    "y_current()",  # of a session with scans before
    "list_",  # those of its hardware
    "chfname(0,)", "chfname(100,)",  # where it saves
    "rtquery('",  # where the tip is
)  # fmt: skip


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Bench]]:
    for name in ("HOME", "USERPROFILE"):  # the bridge's secret and the callers' lock are this test's own
        monkeypatch.setenv(name, str(tmp_path))
    use_temporary_folder(tmp_path, monkeypatch)
    yield from benches(Bench, tmp_path)


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


def test_real_scan_stopped_while_the_panel_repeats_is_not_published(tmp_path: Path) -> None:
    # In the recording it is stopped at row 28 of 60; the scan before it is lost, as Auto Save was off.
    publishes_no_stopped_scan(recording("gxsm4-shm-repeat-at-panel-stopped"), tmp_path)


def test_repeated_real_scans_are_separated_by_their_lines_alone(tmp_path: Path) -> None:
    # The worst case: no poll falls between two scans, and the file name stays the same.
    scan_s = 0.66

    def line(at_s: float) -> int:
        return 59 if at_s < 4.05 else min(int((at_s - 4.05) % scan_s / scan_s * 60), 59 if at_s < 4.71 else 28)

    def bits(at_s: float) -> list[float]:
        return [3.0 if 4.03 <= at_s < 5.01 else 1.0, 0.0, 0.0]

    def name(_: float) -> str:
        return "./not-set155-M-Xp-ZSmTopo.nc"

    made_up = {"y_current": line, "rtquery": bits, "chfname 0": name}
    driver, link, clock = played(recording("gxsm4-shm-repeat-at-panel-stopped"), tmp_path, **made_up)
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
    driver, found = scanned_one_by_one(recording(trace), tmp_path, 8.0)
    assert len(found) == 2
    for states, scans in found:
        assert states == [ScopeState.SCANNING, ScopeState.FREE]
        assert {scan.channel for scan in scans} == channels
    assert names.START_SCAN in driver.own_actions()
