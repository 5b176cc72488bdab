"""`afspm shadow` beside a person at an emulated Nanonis, with all of its processes."""

from __future__ import annotations

import csv
import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from makers import MAKERS
from tests.system.experiment.experiment_lab import AfspmRun
from tests.system.experiment.test_at_the_panel import STOP, UP, panel, set_speed
from typer.testing import CliRunner, Result

from afspm.cli.app import app
from afspm.client.connect import join
from afspm.model import ControlRequest, ScopeState
from afspm.night.run import open_run
from afspm.simulation.emulation.playback import Playback
from afspm.translator.trace import TracedExchange, read_trace

EXPERIMENT = """
[clock]
speed = 20.0

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [32, 32]
every = "1 s"
scans = 3
end_when_done = true

[classifier]
component = true
class = "TipClassifier"

[corrector]
component = true
class = "TipCorrector"
workshop_center = ["8 um", "0 um"]
pulse_voltages = ["3 V"]

[metadata]
sample = "Ada's graphene"

[limits.tip-bias-voltage]
max = "2 V"
"""

LINES = """
[microscope]
live_lines_s = "0.5 s"
"""


@pytest.fixture
def run(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[AfspmRun]:
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT + getattr(request, "param", ""), encoding="utf-8")
    options = ("--runs", str(tmp_path / "runs"))
    one = AfspmRun("shadow", str(file), str(MAKERS["nanonis"].emulated), *options, folder=tmp_path)
    yield one
    one.close()


def afspm_here(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(one) for one in arguments])


def assert_pack_is_free_of_names_and_plays_back(folder: Path, pack: Path) -> None:
    asked = afspm_here("shadow", "pack", folder, "--out", pack)
    assert asked.exit_code == 1  # nobody has confirmed
    assert not pack.exists()
    assert "Ada's graphene" in asked.output
    assert afspm_here("shadow", "pack", folder, "--out", pack, "--yes").exit_code == 0
    before, after = (read_trace(one / "controller.trace.jsonl") for one in (folder, pack))
    for file in pack.rglob("*.*"):
        if file.is_file():
            content = file.read_bytes()
            assert not [word for word in (b"Ada", b"graphene", str(folder.parent).encode()) if word in content]
    # a client that asks the same gets the same answers, of the same lengths
    playback, clients = Playback(after), dict[int, int]()
    exchanges = [pair for pair in zip(before, after, strict=True) if isinstance(pair[0], TracedExchange)]
    for one, other in exchanges[:200]:
        assert isinstance(one, TracedExchange)
        assert isinstance(other, TracedExchange)
        assert len(one.answered) == len(other.answered)
        if one.asked is None or one.lost:
            continue
        client = clients[one.connection] = clients.get(one.connection, -1)
        if client < 0:
            client = clients[one.connection] = playback.connect()
        played = playback.ask(client, one.asked)
        assert played is not None
        assert played.content == other.answered


def test_shadow_reports_a_persons_night_and_sends_no_command(run: AfspmRun, tmp_path: Path) -> None:
    run.wait_for("waiting for control")  # the series would scan, if it were in control
    with join(run.folder, "witness") as scope:
        assert scope.wait_until(lambda: scope.state is ScopeState.FREE, timeout_s=DEADLINE_S)
        with panel(run) as person:
            before = person.Bias_Get()[2][0]
            journal = scope.events("JournalEntries", timeout_s=DEADLINE_S)
            published = (entry for event in journal for entry in event.message.entries)
            set_speed(person, 10e-9)  # the scan takes minutes
            assert any("scan-speed" in entry.what for entry in published)
            person.Scan_Action(0, UP)
            assert scope.wait_until(lambda: scope.state is ScopeState.SCANNING, timeout_s=DEADLINE_S)
            # a detector flags a problem: it is noted, and the person answers by a stop
            scope.flag("tip-shape-changed")
            assert not scope.control_state.problems
            person.Scan_Action(STOP, UP)
            assert scope.wait_until(lambda: scope.state is ScopeState.FREE, timeout_s=DEADLINE_S)
            assert person.Bias_Get()[2][0] == before
            person.Bias_Set(5.0)
            assert any("tip-bias-voltage" in entry.what for entry in published)
    run.process.send_signal(signal.SIGINT)
    run.end()
    assert "problem: 1, the person acted at 1 of them" in run.output
    with open_run(run.folder) as found:
        assert [one.interrupted for one in found.scans] == [True]
        assert not [one for one in found.journal if one.request == ControlRequest.REQUEST_CTRL and one.response == 0]
    rows = list(csv.DictReader((run.folder / "shadow.csv").read_text(encoding="utf-8").splitlines()))
    assert [(row["kind"], bool(row["person"])) for row in rows if row["afspm"]] == [
        ("control", False),
        ("problem", True),
        ("repair", True),
        ("limit", True),
    ]
    (repair,) = [row["afspm"] for row in rows if row["kind"] == "repair"]
    assert repair == "corrector would have been given control to solve tip-shape-changed"
    assert [row["afspm"].split(":")[0] for row in rows if row["kind"] == "limit"] == ["would have refused this"]
    slowed, *acts = [row["person"].split(",")[0] for row in rows if not row["afspm"]]
    assert slowed.startswith("set at the microscope: scan-speed = 10 nm/s")
    assert acts[-3:] == [
        "a scan was begun at the microscope",
        "scan 1 ended before its last line",
        "set at the microscope: tip-bias-voltage = 5 V (before: 100 mV)",
    ]
    assert "What afspm would have done" in (run.folder / "report.html").read_text(encoding="utf-8")
    (problem,) = [row["number"] for row in rows if row["kind"] == "problem"]
    assert afspm_here("note", run.folder, "wrong, Ada looked", "--row", problem).exit_code == 0
    assert "1 row marked" in (run.folder / "report.html").read_text(encoding="utf-8")
    assert_pack_is_free_of_names_and_plays_back(run.folder, tmp_path / "pack")
    lines = (run.folder / "controller.trace.jsonl").read_text(encoding="utf-8").splitlines()[1:]
    asked = {json.loads(line).get("what", "") for line in lines if line.endswith("}")}
    assert len(asked) > 10
    assert [one for one in asked if not re.fullmatch(r"\w+\.\w*Get|Scan\.(WaitEndOfScan|FrameDataGrab)|", one)] == []


@pytest.mark.parametrize("run", [LINES], indirect=True, ids=["live lines"])
def test_detectors_see_the_scans_and_lines_of_a_person(run: AfspmRun) -> None:
    run.wait_for("waiting for control")
    with join(run.folder, "witness") as scope:
        assert scope.wait_until(lambda: scope.state is ScopeState.FREE, timeout_s=DEADLINE_S)
        lines = scope.events("ScanLines", timeout_s=DEADLINE_S)
        with panel(run) as person:
            person.Scan_BufferSet([14], 32, 32)  # of the signals: Z
            person.Scan_SpeedSet(1e-6, 1e-6, 1.0, 1.0, 1, 1.0)
            person.Scan_Action(0, UP)
            first = next(lines).message
            assert first.shape == (32, 32)
        run.wait_for(r"classifier .*reference 1 of")
