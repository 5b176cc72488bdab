"""The checks find nothing wrong with what is right, put everything back, can join what runs, and be interrupted."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from afspm_process import AFSPM
from deadlines import DEADLINE_S
from systems import can_interrupt, interrupt

from afspm.basics.errors import ConfigError
from afspm.storage.memory import Memory
from afspm.supervisor.ports import FreePorts
from afspm.testing.translators import CheckOptions, CheckOutcome, CheckReport, client, run
from afspm.testing.translators.translator_suite import TRANSLATOR_SUITE

EXPERIMENT = """
[clock]
speed = 20.0

[microscope]
component = true
class = "Simulator"
surface = "particles"
initial = { tip-bias-voltage = "200 mV", scan-angle = "3 deg" }
"""
SAMPLE_COORDINATES = """
[control]
solved_by_hand = ["thermal-drift", "device-malfunction"]

[scheduler]
component = true
class = "DriftCompensatedScheduler"
"""
SCHEDULER = """
security = {{ insecure = true }}
router_url = "{router}"
publish_url = "{publish}"

[scheduler]
component = true
class = "Scheduler"
pubsubcache = "publish_url"
router = "router_url"

[witness]
component = true
class = "Metadata"
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    written = tmp_path / "experiment.toml"
    written.write_text(EXPERIMENT, encoding="utf-8")
    return written


def values(report: CheckReport) -> dict[str, Any]:
    """What is in force at the simulated controller, as it keeps it."""
    found: dict[str, Any] = Memory(Path(report.folder) / "state" / "microscope.json")["microscope"]["values"]
    return found


def test_the_simulator_does_all_that_it_should_and_is_left_as_it_was(file: Path) -> None:
    report = run(CheckOptions([file], runs=file.parent / "runs"))
    assert report.passed, report
    assert [result.name for result in report.results] == [check.name for check in TRANSLATOR_SUITE.checks()]
    # on a busy computer a spectrum of this clock (0.1 s) may end before it is stopped
    missed = [result for result in report.results if result.outcome is not CheckOutcome.PASSED]
    assert not missed or [(one.name, one.outcome) for one in missed] == [("spectrum/cancel", CheckOutcome.SKIPPED)]
    after = values(report)
    assert after["tip-bias-voltage"] == pytest.approx(0.2)
    assert after["scan-angle"] == pytest.approx(3.0)
    assert after["scan-size-x"] == pytest.approx(1000.0)
    assert after["scan-speed"] == pytest.approx(2.0)
    assert after["scan-resolution-x"] == 128
    assert after["x-feedback-on"] is True


def test_report_lists_supported_and_unsupported_operations(file: Path) -> None:
    report = run(CheckOptions([file], runs=file.parent / "runs", only=["parameter/tip-bias"]))
    written = json.loads((Path(report.folder) / "report.json").read_text(encoding="utf-8"))
    assert written["passed"] is True
    assert written["controller"].startswith("simulated microscope of afspm")
    assert [check["name"] for check in written["checks"]] == ["parameter/tip-bias-voltage"]
    actions = {action["name"]: action["supported"] for action in written["actions"]}
    assert actions["start-scan"] is True
    assert actions["x-fault"] is False
    parameters = {parameter["name"]: parameter for parameter in written["parameters"]}
    assert parameters["tip-bias-voltage"] == {
        "name": "tip-bias-voltage", "supported": True, "value": "0.2", "unit": "V", "settable": True,
    }  # fmt: skip
    assert parameters["x-fault-kind"]["supported"] is False


def test_unsupported_operation_is_skipped_and_listed(tmp_path: Path) -> None:
    module = tmp_path / "poor.py"
    module.write_text(
        "from afspm.simulation.simulator import Simulator\n\n\n"
        "class Poor(Simulator):\n"
        "    def __init__(self, **settings):\n"
        "        super().__init__(**settings)\n"
        '        self.table = self.table.without(["scan-angle", "zctrl-igain"])\n'
        "        self._initial = {name: value for name, value in self._initial.items() if name in self.table}\n\n"
        "    def own_actions(self):\n"
        '        return {name: done for name, done in super().own_actions().items() if "spec" not in name}\n',
        encoding="utf-8",
    )
    file = tmp_path / "experiment.toml"
    file.write_text('[microscope]\ncomponent = true\nclass = "poor.Poor"\n', encoding="utf-8")
    report = run(CheckOptions([file], runs=tmp_path / "runs", only=["turned", "spectrum/", "igain", "frame/set"]))
    lines = {result.name: result.line for result in report.results if result.outcome is CheckOutcome.SKIPPED}
    assert lines["scan/turned"] == "not supported: scan-angle"
    assert lines["spectrum/order"] == "not supported: start-spec"
    assert lines["parameter/zctrl-igain"] == "not supported: zctrl-igain"
    assert [result.name for result in report.results if result.outcome is CheckOutcome.PASSED] == ["frame/set"]
    assert report.passed
    assert report.support.actions["start-spec"] is False


def test_spectrum_too_short_to_be_stopped_is_reported(file: Path) -> None:
    report = run(
        CheckOptions([file], runs=file.parent / "runs", speed=5000.0, only=["spectrum/cancel", "spectrum/order"])
    )
    outcomes = {result.name: (result.outcome, result.line) for result in report.results}
    assert outcomes["spectrum/cancel"] == (CheckOutcome.SKIPPED, "a spectrum ends before it can be stopped")
    assert outcomes["spectrum/order"] == (CheckOutcome.PASSED, "")


@contextmanager
def started(*arguments: str, cwd: Path) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [*AFSPM, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8", cwd=cwd,
        start_new_session=True,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


def until(process: subprocess.Popen[str], words: str) -> None:
    assert process.stdout is not None
    heard = []
    for line in process.stdout:
        heard.append(line)
        if words in line:
            return
    raise AssertionError(f"{words!r} did not come: {heard}")


def test_running_ones_are_joined_and_left_running(file: Path) -> None:
    ports = FreePorts()
    addresses = SCHEDULER.format(router=ports.address(), publish=ports.address())
    file.write_text(addresses + EXPERIMENT, encoding="utf-8")
    with started("run", "experiment.toml", "-v", cwd=file.parent) as process:
        until(process, "scheduler  is up")
        options = CheckOptions(
            [file], ["scheduler", "microscope"], file.parent / "joined", only=["frame/set", "unknown"]
        )
        for _ in range(2):  # who was there before is nobody's business
            report = run(options)
            assert report.passed, report
            assert len(report.results) == 3
        assert process.poll() is None


@can_interrupt
def test_ctrl_c_in_the_middle_of_a_scan_puts_everything_back(file: Path) -> None:
    with started("test-translator", "experiment.toml", "-k", "frame/set", "-k", "busy/", cwd=file.parent) as process:
        until(process, "frame/set")  # the next check scans for seconds
        interrupt(process)
        assert process.stdout is not None
        output = process.stdout.read()
        assert process.wait(DEADLINE_S) == 130
    assert "not completed: interrupted" in output
    (folder,) = (file.parent / "runs").glob("test-*")
    written = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert written["unrestored"] == []
    assert written["passed"] is False
    kept = Memory(folder / "state" / "microscope.json")["microscope"]
    assert kept["values"]["scan-size-x"] == pytest.approx(1000.0)
    instrument = kept["instrument"]["instrument"]
    assert [instrument[what] for what in ("scan", "spectrum", "move", "occupied")] == [None] * 4


def test_report_quotes_a_translator_without_its_controller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "STARTED_S", 8.0)
    (tmp_path / "deaf.py").write_text(
        "from afspm.simulation.simulator import Simulator\n\n\n"
        "class Deaf(Simulator):\n"
        "    def connect(self):\n"
        '        raise ConnectionError("nobody is at home")\n',
        encoding="utf-8",
    )
    file = tmp_path / "experiment.toml"
    file.write_text('[microscope]\ncomponent = true\nclass = "deaf.Deaf"\n', encoding="utf-8")
    report = run(CheckOptions([file], runs=tmp_path / "runs"))
    assert "a connection to the controller" in report.lost
    assert "nobody is at home" in report.lost
    assert not report.passed


def test_the_command_ends_with_1_where_something_is_wrong_and_says_what(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text((Path(__file__).with_name("broken.py")).read_text(encoding="utf-8"))
    file = tmp_path / "experiment.toml"
    file.write_text('[microscope]\ncomponent = true\nclass = "broken.KnowsEveryAction"\n', encoding="utf-8")
    with started("test-translator", "experiment.toml", "-k", "unknown", "--report", "r.json", cwd=tmp_path) as process:
        output, _ = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 1
    assert "✗ refused/unknown-action: expected REP_ACTION_NOT_SUPPORTED" in output
    assert "1 passed, 1 failed" in output
    assert json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))["passed"] is False


def test_real_microscope_waits_for_the_confirmation_that_the_tip_is_withdrawn(tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text('[microscope]\ncomponent = true\nclass = "Nanonis"\n', encoding="utf-8")
    command = [*AFSPM, "test-translator", "experiment.toml"]
    done = subprocess.run(
        command, cwd=tmp_path, input="n\n", capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False
    )
    assert done.returncode == 1
    assert "Is the tip so far from the sample that it can't reach it" in done.stdout
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[watcher]\ncomponent = true\nclass = "Metadata"\n', "there is no translator"),
        (EXPERIMENT + EXPERIMENT.replace("[microscope]", "[another]").split("20.0")[1], "translator"),
        (EXPERIMENT + SAMPLE_COORDINATES, "in tip coordinates"),
    ],
)
def test_what_can_not_be_checked_is_refused_before_anything_starts(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=said):
        run(CheckOptions([file], runs=tmp_path / "runs"))
    with pytest.raises(ConfigError, match="no check is called no-such-check"):
        run(CheckOptions([file], runs=tmp_path / "runs", only=["no-such-check"]))
    assert not (tmp_path / "runs").exists()


def test_as_a_pytest_plugin_each_check_is_a_test(file: Path) -> None:
    command = [
        sys.executable, "-m", "pytest", "-p", "afspm.testing.translators.plugin", "-p", "no:cacheprovider", "-v",
        "-k", "unknown or free", "experiment.toml",
    ]  # fmt: skip
    (file.parent / "pytest.ini").touch()
    done = subprocess.run(
        command, cwd=file.parent, capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False
    )
    assert done.returncode == 0, done.stdout
    assert "refused/unknown-action PASSED" in done.stdout
    assert "3 passed" in done.stdout
    assert re.search(r"start-scan +base +yes", done.stdout)


def test_a_plain_pytest_does_not_look_at_experiment_files(file: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--trace-config", "experiment.toml"]
    (file.parent / "pytest.ini").touch()
    done = subprocess.run(
        command, cwd=file.parent, capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False
    )
    assert "afspm" not in done.stdout.replace(str(file.parent), "")
    assert done.returncode != 0
