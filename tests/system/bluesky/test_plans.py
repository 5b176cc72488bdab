"""The microscope in plans of Bluesky, with its RunEngine, and documents of a run, judged by its event model."""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

import afspm
from afspm.basics.errors import UnitError
from afspm.model import ScopeState

pytest.importorskip("ophyd_async", reason="Bluesky is not installed")

import bluesky.plan_stubs as bps
import bluesky.plans as bp
from bluesky import RunEngine
from bluesky.utils import FailedStatus, RequestAbort, RunEngineInterrupted
from event_model import DocumentNames, schema_validators
from ophyd_async.core import DEFAULT_TIMEOUT, init_devices

from afspm.plugins.bluesky.microscope import Microscope

pytestmark = [pytest.mark.filterwarnings("ignore")]
PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "bluesky.md"
AFSPM = (sys.executable, "-m", "afspm")
EXPERIMENT = """
name = "night"

[microscope]
component = true
class = "Simulator"
initial = { scan-speed = "40 um/s", scan-resolution-x = 32, scan-resolution-y = 32 }

[scheduler]
component = true
class = "Scheduler"

[limits.tip-bias-voltage]
max = "3 V"
"""


@pytest.fixture
def runs(tmp_path: Path) -> Iterator[Path]:
    """A running experiment, whose scheduler is up."""
    (tmp_path / "night.toml").write_text(EXPERIMENT, encoding="utf-8")
    command = [*AFSPM, "run", "--verbose", "--no-report", "night.toml"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8"
    ) as run:
        try:
            assert run.stdout is not None
            assert any(" scheduler " in line and "is up" in line for line in run.stdout), "it never started"
            threading.Thread(target=run.stdout.read, daemon=True).start()
            yield tmp_path / "runs"
        finally:
            run.kill()


@pytest.fixture
def scope(runs: Path) -> Any:
    engine = RunEngine()
    with init_devices():
        scope = Microscope(runs, parameters=["tip-bias-voltage", "scan-speed"])
    engine(bps.mv(scope.scan.rows, 32, scope.scan.columns, 32))
    return scope


def test_a_plan_scans_where_its_signals_say(scope: Any) -> None:
    told: list[tuple[str, dict[str, Any]]] = []
    engine = RunEngine()
    engine(bps.mv(scope.tip_bias_voltage, 0.25))
    engine(bp.scan([scope.scan, scope.spectrum], scope.scan.center_x, -1e-6, 1e-6, 3), lambda *one: told.append(one))
    events = [document for name, document in told if name == "event"]
    assert [event["data"]["scope-scan-center_x"] for event in events] == pytest.approx([-1e-6, 0.0, 1e-6])
    assert {event["data"]["scope-scan-height"].shape for event in events} == {(32, 32)}
    (descriptor,) = [document for name, document in told if name == "descriptor"]
    assert descriptor["data_keys"]["scope-scan-height"]["units"] == "m"
    assert descriptor["data_keys"]["scope-spectrum-current"]["units"] == "A"
    for name, document in told:
        schema_validators[DocumentNames[name]].validate(_plain(document))


def test_a_refusal_fails_the_plan_with_the_reason(scope: Any) -> None:
    with pytest.raises(FailedStatus) as failed:
        RunEngine()(bps.mv(scope.tip_bias_voltage, 4.0))
    assert "above the highest allowed" in str(failed.value.__cause__)


def test_a_setting_waits_for_control_as_a_scan_does(scope: Any, runs: Path) -> None:
    holding = threading.Event()

    def hold() -> None:
        with afspm.connect(runs, name="repair") as repair, repair.control():
            holding.set()
            time.sleep(DEFAULT_TIMEOUT + 2.0)  # a tip repair takes minutes

    holder = threading.Thread(target=hold)
    holder.start()
    assert holding.wait(DEADLINE_S)
    RunEngine()(bps.mv(scope.tip_bias_voltage, 0.35))
    holder.join()
    with afspm.connect(runs, name="watcher") as watcher:
        assert watcher.get("tip-bias-voltage") == pytest.approx(0.35)


def test_a_plan_that_is_aborted_stops_its_scan_and_gives_control_back(scope: Any, runs: Path) -> None:
    engine = RunEngine()
    engine(bps.mv(scope.scan_speed, 2e-7, scope.tip_bias_voltage, 0.25))
    scope.scan.stage_sigs["tip-bias-voltage"] = "0.5 V"
    with afspm.connect(runs, name="watcher") as watcher:
        begun = threading.Thread(target=_pause_when_scanning, args=(engine, watcher))
        begun.start()
        with pytest.raises(RunEngineInterrupted):
            engine(bp.count([scope.scan]))
        begun.join()
        with contextlib.suppress(RequestAbort):
            engine.abort("enough")
        assert watcher.wait_until(lambda: watcher.state is ScopeState.FREE, timeout_s=DEADLINE_S)
        with watcher.control(timeout_s=DEADLINE_S):
            assert watcher.in_control
        assert watcher.get("tip-bias-voltage") == pytest.approx(0.25)
    engine(bps.mv(scope.tip_bias_voltage, 0.3))  # and the next plan works


def test_staged_settings_hold_for_the_scans_of_the_plan(scope: Any, runs: Path) -> None:
    documents: list[tuple[str, dict[str, Any]]] = []
    engine = RunEngine()
    engine(bps.mv(scope.tip_bias_voltage, 0.25))
    scope.scan.stage_sigs |= {"tip-bias-voltage": "0.5 V", "scan-speed": 2e-5}
    plan = bp.scan([scope.scan, scope.spectrum], scope.scan.center_x, -1e-6, 1e-6, 2)
    engine(plan, lambda *one: documents.append(one))
    (descriptor,) = [document for name, document in documents if name == "descriptor"]
    shown = descriptor["configuration"]["scope-scan"]
    assert shown["data"] == {
        "scope-scan-rows": 32, "scope-scan-columns": 32,
        "scope-scan-tip_bias_voltage": 0.5, "scope-scan-scan_speed": 2e-5,
    }  # fmt: skip
    assert shown["data_keys"]["scope-scan-tip_bias_voltage"]["units"] == "V"
    assert list(descriptor["configuration"]["scope-spectrum"]["data"]) == ["scope-spectrum-kind"]
    for name, document in documents:
        schema_validators[DocumentNames[name]].validate(_plain(document))
    with afspm.connect(runs, name="watcher") as watcher:
        assert watcher.get("tip-bias-voltage") == pytest.approx(0.25)
    (folder,) = runs.glob("night-*")
    with afspm.open_run(folder) as record:
        assert [_bias(row) for row in record.scans] == [0.5, 0.5]
        assert [_bias(row) for row in record.spectra] == [0.25, 0.25]


def _bias(row: Any) -> object:
    return next(one.begin for one in row.in_force if one.name == "tip-bias-voltage")


def test_wrong_staged_setting_fails_the_plan_before_its_first_scan(scope: Any) -> None:
    scope.scan.stage_sigs["tip-bias-voltage"] = "0.5 nm"
    with pytest.raises(FailedStatus) as failed:
        RunEngine()(bp.count([scope.scan]))
    assert isinstance(failed.value.__cause__, UnitError)


def _pause_when_scanning(engine: RunEngine, watcher: afspm.Scope) -> None:
    assert watcher.wait_until(lambda: watcher.state is ScopeState.SCANNING, timeout_s=DEADLINE_S)
    engine.request_pause(defer=False)


def test_the_plan_of_the_page_runs_and_the_documents_of_the_run_are_valid(runs: Path, tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n# plan\.py\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, encoding="utf-8", check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("(32, 32)") == 3
    subprocess.run([*AFSPM, "end", "runs", "--yes"], cwd=tmp_path, check=True)
    subprocess.run([*AFSPM, "export", "runs", "--to", "documents"], cwd=tmp_path, check=True)
    (file,) = runs.glob("night-*/export/documents/documents.jsonl")
    documents = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    for name, document in documents:
        schema_validators[DocumentNames[name]].validate(document)
    assert [name for name, _ in documents].count("event") == 4  # three scans, one spectrum
    scans = next(document for name, document in documents if name == "descriptor" and document["name"] == "scans")
    assert scans["data_keys"]["height"]["shape"] == [32, 32], "the topography, not the height of the frame"


def _plain(document: dict[str, Any]) -> dict[str, Any]:
    plain: dict[str, Any] = json.loads(json.dumps(document, default=lambda value: value.tolist()))
    return plain
