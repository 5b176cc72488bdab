"""Each of these translators is wrong in one thing, and the checks say in which."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from rich.console import Console

from afspm.model import ScopeState, ScopeStatus
from afspm.testing.conformance import CheckOutcome, show_result
from afspm.testing.translators import CheckOptions, CheckReport, client, run
from afspm.testing.translators.checks import scans
from afspm.testing.translators.session import SPEED

HERE = Path(__file__).parent
STUCK = ("NeverFreeAgain", "SuccessWithoutChange")
"""Of these nothing can be put back."""
EXPERIMENT = """
[microscope]
component = true
class = "{name}"
surface = "particles"
seed = 4
initial = {{ tip-bias-voltage = "200 mV", scan-angle = "3 deg" }}
"""


@pytest.fixture(autouse=True)
def busy_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait longer for answers, so that a late one is not taken for the fault."""
    monkeypatch.setattr(client, "ANSWERED_S", DEADLINE_S)


def checked(folder: Path, name: str, *only: str, speed: float = SPEED) -> CheckReport:
    shutil.copy(HERE / "broken.py", folder)
    file = folder / "experiment.toml"
    file.write_text(EXPERIMENT.format(name=name), encoding="utf-8")
    return run(CheckOptions([file], runs=folder / "runs", only=only, speed=speed))


@pytest.mark.parametrize(
    ("name", "check", "said"),
    [
        ("HalfAFrameOff", "scan/frame", r"off by \(\+0\.50, \+0\.50\) frames"),
        ("OnePixelTooLarge", "scan/frame", r"a size of \(516\.129, 516\.129\) nm instead of \(500, 500\) nm"),
        ("InOtherCoordinates", "scan/frame", r"a size of \(5e\+11, 5e\+11\) nm instead of \(500, 500\) nm"),
        ("SwappedAxes", "scan/not-square", r"a size of \(300, 600\) nm instead of \(600, 300\) nm"),
        ("MirroredY", "scan/picture", "correlation of .*, and of 0.* with y mirrored"),
        ("TurnedTheWrongWay", "scan/picture", "with angles the other way round"),
        ("AngleOfTheWrongSign", "scan/turned", "an angle of -23° instead of 23°"),
        (
            "TimeOfTheStart",
            "scan/time",
            r"the time at which the scan .* ended, .* s from its beginning; came .* s from its beginning",
        ),
        ("WrongUnit", "scan/duration", "from scan-speed .check its unit"),
        ("FreeBeforeTheScan", "scan/order", "SS_SCANNING, Scan2d …, SS_FREE; came SS_SCANNING, SS_FREE, Scan2d"),
        ("CancelIgnored", "scan/cancel", "expected .*SS_FREE.*; came "),
        ("CancelledSpectrumUntold", "spectrum/cancel", "expected SS_INTERRUPTED.*; came SS_SPEC, SS_FREE"),
        ("SpectrumElsewhere", "spectrum/position", r"expected a spectrum at .*; came \(0, 0\) nm"),
        ("NotOnlyWhatWasAsked", "frame/position-only", "scan-size-x: the controller set 100 nm instead of 300 nm"),
        ("NeverFreeAgain", "frame/set", "expected SS_FREE within"),
        ("PublishesTwice", "frame/set", "ScanParameters2d once.*; came SS_MOVING, ScanParameters2d, ScanParameters2d"),
        ("SuccessWithoutChange", "feedback/numbers", "expected ZCtrlParameters with proportional_gain = "),
        ("Clamps", "refused/too-large", "REP_PARAM_ERROR to scan-size-x = '1000' m; came REP_SUCCESS"),
        ("AcceptsNaN", "refused/sample-slope-x", "REP_PARAM_ERROR to sample-slope-x = 'nan'; came REP_SUCCESS"),
        ("AnyUnit", "refused/scan-speed", "REP_PARAM_ERROR to scan-speed = '2e-06' kg; came REP_SUCCESS"),
        ("KnowsEveryAction", "refused/unknown-action", "REP_ACTION_NOT_SUPPORTED .*; came REP_SUCCESS"),
        ("BusyNotRefused", "busy/refused", "REP_NOT_FREE to .* while SS_SCANNING; came REP_"),
        ("SaysNothingAtTheStart", "published/in-force", "expected a ScanParameters at the start"),
    ],
)
def test_fault_is_reported_in_one_line(
    name: str, check: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name in STUCK:  # it is waited for twice, in vain
        monkeypatch.setattr(client, "NOTICED_S", 4.0)
    # a spectrum of a second would be over before a busy computer stops it
    report = checked(tmp_path, f"broken.{name}", check, speed=1.0 if check == "spectrum/cancel" else SPEED)
    lines = {failure.name: failure.line for failure in report.failed}
    assert list(lines) == [check], report
    assert "\n" not in lines[check]
    assert re.search(said, lines[check]), lines[check]
    assert not report.passed
    if name not in STUCK:
        assert report.unrestored == []


def test_what_a_translator_logs_is_shown_with_the_check_that_failed(tmp_path: Path) -> None:
    report = checked(tmp_path, "broken.LosesScans", "scan/frame")
    (failure,) = report.failed
    assert any("is lost" in line and line.startswith("microscope: ") for line in failure.complaints)
    console = Console(width=200)
    with console.capture() as shown:
        show_result(failure, console)
    assert "is lost" in shown.get()


def test_checks_without_their_scan_name_the_check_with_the_reason(tmp_path: Path) -> None:
    report = checked(tmp_path, "broken.LosesScans", "scan/frame", "scan/in-force")
    assert [failure.name for failure in report.failed] == ["scan/frame"]
    assert report.results[-1].line == "the scan of the plain frame failed, see scan/frame"


def test_repeated_states_are_shown_once_with_their_number() -> None:
    status, other = (
        client.Observation("", ScopeStatus(state), None) for state in (ScopeState.UNDEFINED, ScopeState.FREE)
    )
    shown = client.describe_all([*[status] * 29, other, other])
    assert shown == "SS_UNDEFINED (29 times), SS_FREE, SS_FREE"


def test_what_a_controller_is_known_not_to_do_is_skipped_with_the_reason(tmp_path: Path) -> None:
    report = checked(tmp_path, "broken.TurnedAsIsKnown", "scan/picture")
    (result,) = report.results
    assert result.outcome is CheckOutcome.SKIPPED
    assert "is known to turn: expected details" in result.line
    assert report.passed


def test_a_spectrum_that_goes_on_when_it_is_stopped_is_not_one_that_was_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "NOTICED_S", 4.0)  # what is waited for in vain
    report = checked(tmp_path, "broken.SpectrumNotStopped", "spectrum/cancel", speed=1.0)
    (failure,) = report.failed
    assert re.search("expected SS_INTERRUPTED .*; came SS_SPEC, Spec1d, SS_FREE", failure.line), failure.line


def test_the_scan_before_is_not_taken_for_the_new_one(tmp_path: Path) -> None:
    report = checked(tmp_path, "broken.StaleScan", "scan/not-square", "scan/turned")
    assert [failure.name for failure in report.failed] == ["scan/turned"], report
    assert "a size of (600, 300) nm instead of" in report.failed[0].line


def test_death_of_the_translator_ends_the_trial_with_a_report(tmp_path: Path) -> None:
    report = checked(tmp_path, "broken.DiesOfNaN", "refused/scan-speed", "refused/move-speed")
    assert "the process microscope" in report.lost
    assert "exit code 3" in report.lost
    assert report.results == []
    assert not report.passed


def test_setting_that_cannot_be_restored_is_reported(tmp_path: Path) -> None:
    report = checked(tmp_path, "broken.OnlyUpwards", "parameter/tip-bias-voltage")
    assert len(report.unrestored) == 1
    assert "the bias is stuck" in report.unrestored[0]
    assert not report.passed
    written = json.loads((Path(report.folder) / "report.json").read_text(encoding="utf-8"))
    assert written["unrestored"] == report.unrestored


# makers C1: 75 checks passed
def test_stop_without_effect_is_no_stop_and_the_report_ends_with_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scans, "STOPPED_REAL_S", 4.0)
    file = tmp_path / "experiment.toml"
    controller = '[controller]\ncomponent = true\nclass = "NanonisEmulator"\nas_reported = ["deaf-stop"]\n'
    file.write_text(f'{controller}\n[microscope]\ncomponent = true\nclass = "Nanonis"\n', encoding="utf-8")
    report = run(CheckOptions([file], runs=tmp_path / "runs", only=["scan/cancel"]))
    (failure,) = report.failed
    assert re.search(r"expected SS_FREE within .* s of stop-scan; came .* s, of a scan of 80 s", failure.line)
    logged = json.loads((Path(report.folder) / "report.json").read_text(encoding="utf-8"))["logged"]
    assert any(line.startswith("controller: WARNING SIMULATED") for line in logged), logged


@pytest.mark.parametrize(("left_s", "busy_s", "idle_s"), [(39.0, 19.5, 5.0), (6.0, 3.0, 3.0), (None, math.inf, 5.0)])
def test_stop_ends_a_scan_well_before_its_own_end(left_s: float | None, busy_s: float, idle_s: float) -> None:
    assert scans.longest_stop_s(left_s, is_simulated=True) == busy_s
    assert scans.longest_stop_s(left_s, is_simulated=False) == idle_s
