"""A person at the panel goes through every vendor's emulator: what is right passes, what is wrong is found."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import pytest
from deadlines import DEADLINE_S
from makers import MAKERS
from rotation import rotated
from systems import can_interrupt, freeze, interrupt, not_on_wine

from afspm.basics import ConfigError
from afspm.driver import Driver
from afspm.plugins.asylum import Asylum
from afspm.plugins.asylum import link as asylum
from afspm.plugins.gxsm import Gxsm
from afspm.plugins.nanonis import Nanonis
from afspm.plugins.nanonis import session as nanonis
from afspm.plugins.nanosurf import Nanosurf
from afspm.plugins.nanosurf import link as nanosurf
from afspm.plugins.park import Park
from afspm.testing.commissioning import maker_claims
from afspm.testing.commissioning.guide import NO_PANEL, Guide
from afspm.testing.commissioning.procedure import REHEARSAL_PATIENCE, CommissioningResult, commission
from afspm.testing.commissioning.report import InstrumentReport
from afspm.testing.conformance import CheckOutcome
from afspm.testing.translators import CheckOptions
from afspm.testing.translators.checks import scans
from afspm.testing.translators.measuring import STOPPED_REAL_S
from afspm.translator.trace import FILE, TracedExchange, read_trace

HERE = Path(__file__).parent
VENDORS = tuple(maker.driver for maker in MAKERS.values())
ONE_VENDOR = rotated(VENDORS, len(VENDORS))
"""Where the same is tried with each: one at each commit."""
EXPERIMENT = """
[controller]
component = true
class = "{vendor}Emulator"
surface = "particles"
seed = 7
{controller}
[microscope]
component = true
class = "{driver}"
"""


@dataclass
class Person:
    """Answers as one at an emulator does, who sees where a frame is and no numbers.

    Attributes:
        says: answers to the questions that have these words in them.
        shown: all texts.
    """

    says: dict[str, str | bool | Callable[[], str]] = field(default_factory=dict)
    shown: list[str] = field(default_factory=list)

    def show(self, text: str) -> None:
        self.shown.append(text)

    def confirm(self, question: str) -> bool:
        return self._said(question, "y") in ("y", True)

    def text(self, question: str) -> str:
        default = "u" if "(u:" in question else ""
        return str(self._said(question, default))

    def choose(self, question: str, options: Sequence[str], default: str = "") -> str:
        return str(self._said(question, options[0]))

    def _said(self, question: str, default: str) -> str | bool:
        self.shown.append(question)
        answer = next((answer for words, answer in self.says.items() if words in question), default)
        return answer() if callable(answer) else answer


def commissioned(
    folder: Path,
    vendor: str,
    person: Person,
    driver: str = "",
    *,
    patience: float = REHEARSAL_PATIENCE,
    settings: str = "",
    controller: str = "",
    only: str = "",
    frame_m: float | None = None,
) -> CommissioningResult:
    shutil.copy(HERE / "spoiled.py", folder)
    file = folder / "experiment.toml"
    text = EXPERIMENT.format(vendor=vendor, driver=driver or vendor, controller=controller)
    file.write_text(text + settings, encoding="utf-8")
    report = folder / "report.toml"
    before = InstrumentReport.read(report) if report.exists() else None
    options = CheckOptions([file], runs=folder / "runs", patience=patience, frame_m=frame_m)
    return commission(options, person, report, "emulator", before, has_panel=True, only=only)


@pytest.fixture
def spoiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make `spoiled.py` importable, in the processes of the experiment, too."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


@pytest.mark.parametrize("vendor", VENDORS)
def test_a_controller_that_is_right_passes_and_the_report_says_what_was_tried(vendor: str, tmp_path: Path) -> None:
    person = Person()
    result = commissioned(tmp_path, vendor, person)
    lines = {name: f"{one.outcome.value}: {one.line}" for name, one in result.progress.results.items()}
    assert result.passed, (result.lost, [line for line in lines.values() if not line.startswith("passed")])
    report = InstrumentReport.read(tmp_path / "report.toml")
    assert not report.unrestored
    assert report.tried_on == "emulator"
    assert report.operations["scan"] == report.operations["axes"] == report.operations["stop"] == "passed", lines
    assert vendor != "Nanonis" or report.claims["withdrawn-limit"] == "holds"
    verdicts = {name: [line for line in person.shown if line.endswith(f" ({name})")] for name in report.claims}
    assert not {name: shown for name, shown in verdicts.items() if len(shown) > 1}  # makers C4: not shown, then holds
    assert ("on your word alone" in lines["withdrawn"]) is (vendor not in ("Nanonis", "Asylum")), lines
    exchanges = [one for one in read_trace(result.folder / FILE) if isinstance(one, TracedExchange)]
    assert any("start-scan" in one.command for one in exchanges)


@pytest.mark.parametrize("vendor", ONE_VENDOR)
@pytest.mark.parametrize(
    ("fault", "step", "said"),
    [
        ("MirroredY", "moved-frame", "y is mirrored"),
        ("OtherWay", "moved-frame", "a frame turned by 20 deg is turned by -"),
        ("LateEnd", "scan", "until its end was noticed"),
    ],
)
def test_fault_of_a_controller_is_found(
    vendor: str, fault: str, step: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    person = Person()
    # as patient as at a real instrument: a busy computer makes a late end only later
    patience = 1.0 if fault == "LateEnd" else REHEARSAL_PATIENCE
    result = commissioned(tmp_path, vendor, person, f"spoiled.{fault}{vendor}", patience=patience)
    found = result.progress.results[step]
    assert found.outcome is CheckOutcome.FAILED, (found, result.lost)
    # a driver that compares the frame with the one at the start of its scan notices it first
    assert said in found.line or (fault == "OtherWay" and "SS_INTERRUPTED" in found.line)
    assert any("What to do: " in line for line in person.shown)
    assert not result.passed
    if step == "moved-frame":
        assert any("The tip was withdrawn" in line or "WITHDRAW" in line.upper() for line in person.shown)
    else:  # nothing that needs the step is done
        assert result.progress.results["axes"].outcome is CheckOutcome.BLOCKED


@pytest.mark.parametrize("vendor", sorted({"Nanonis", *ONE_VENDOR}))
@pytest.mark.parametrize(
    ("words", "answer", "step", "said"),
    [
        ("width of the frame", "77 um", "panel", "77 um"),
        ("pixels in a line", "17", "panel", "17"),
        ("Where to, in the panel", "down", "frame", "down at the panel"),
        ("which way is it turned", "clockwise", "angle", "clockwise at the panel"),
    ],
)
def test_a_panel_that_shows_something_else_is_a_mismatch(
    vendor: str, words: str, answer: str, step: str, said: str, tmp_path: Path
) -> None:
    if vendor != "Nanonis" and step != "panel":
        pytest.skip("what the person sees is the same with each vendor")
    result = commissioned(tmp_path, vendor, Person({words: answer, "Is the tip at the sample": False}))
    found = result.progress.results[step]
    assert found.outcome is CheckOutcome.FAILED
    assert said in found.line


# results X4
@pytest.mark.parametrize(
    ("driver", "shown"), [(Gxsm, "20"), (Nanonis, "20"), (Asylum, "20"), (Park, "-20"), (Nanosurf, "-20")]
)
def test_angle_is_typed_as_the_panel_shows_it(driver: type[Driver], shown: str, tmp_path: Path) -> None:
    kit: Any = None
    person = Person({"angle": shown})
    assert Guide(kit, person, tmp_path, counts_clockwise=driver.counts_clockwise).compare_angle(-20.0)


# results X4: the advice turned every frame the wrong way
def test_no_sign_is_changed_for_an_angle_that_differs(tmp_path: Path) -> None:
    person = Person({"angle": "77", "Is the tip at the sample": False})
    result = commissioned(tmp_path, "Gxsm", person)
    found = result.progress.results["panel"]
    assert found.outcome is CheckOutcome.FAILED
    assert "77" in found.line
    advice = [line for line in person.shown if "What to do" in line]
    assert advice
    assert not any("sign" in line for line in advice)


def test_a_panel_that_shows_the_width_of_whole_pixels_is_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    person = Person({"of the frame": "1 um", "pixels in a line": "32", "scanner can't reach it": False})
    result = commissioned(tmp_path, "spoiled.CoarseNanonis", person, "Nanonis")
    panel = result.progress.results["panel"]
    assert (panel.outcome, panel.line) == (CheckOutcome.PASSED, "3 values are those of the panel")
    assert any("afspm reads 968.75 nm: the same" in line for line in person.shown)


def test_nothing_is_moved_before_it_is_confirmed(tmp_path: Path) -> None:
    result = commissioned(tmp_path, "Nanonis", Person({"scanner can't reach it": False}))
    exchanges = [one for one in read_trace(result.folder / FILE) if isinstance(one, TracedExchange)]
    assert not [one.what for one in exchanges if one.command]
    assert result.progress.results["frame"].outcome is CheckOutcome.BLOCKED


def test_it_goes_on_where_it_was_left_and_asks_for_the_tip_again(tmp_path: Path) -> None:
    def leave() -> str:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        commissioned(tmp_path, "Nanonis", Person({"Has the panel stopped": leave}))
    left = InstrumentReport.read(tmp_path / "report.toml")
    assert left.steps["scan"]["outcome"] == "passed"
    assert "stop" not in left.steps
    assert not left.unrestored
    person = Person({"Is the tip at the sample": False})
    result = commissioned(tmp_path, "Nanonis", person)
    assert any("scanner can't reach it" in line for line in person.shown)
    assert not any("afspm takes one scan" in line for line in person.shown)
    assert result.progress.results["stop"].outcome is CheckOutcome.PASSED


def test_ctrl_c_in_contact_withdraws_the_tip(tmp_path: Path) -> None:
    def leave() -> str:
        raise KeyboardInterrupt

    person = Person({"Does the panel show the same picture": leave})
    with pytest.raises(KeyboardInterrupt):
        commissioned(tmp_path, "Nanonis", person)
    assert "The tip was withdrawn." in person.shown
    (run,) = (tmp_path / "runs").glob("test-*")
    exchanges = [one for one in read_trace(run / FILE) if isinstance(one, TracedExchange)]
    assert any("x-retract" in one.command for one in exchanges)
    assert not InstrumentReport.read(tmp_path / "report.toml").unrestored


# makers C3: 14 of 14 steps ran
@pytest.mark.parametrize(("driver", "withdrawn"), [("", "false"), ("spoiled.OtherZNanonis", "true")])
def test_tip_that_reads_as_at_the_sample_is_not_believed_to_be_withdrawn(
    driver: str, withdrawn: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    person = Person()
    result = commissioned(tmp_path, "Nanonis", person, driver, controller=f"withdrawn = {withdrawn}\n")
    found = result.progress.results["withdrawn"]
    assert found.outcome is CheckOutcome.FAILED
    assert "expected the tip withdrawn, as you say; came x-engaged reads true" in found.line
    assert "or z counts the other way" in found.line
    assert any("What to do: Withdraw the tip at the panel" in line for line in person.shown)
    assert result.progress.results["frame"].outcome is CheckOutcome.BLOCKED
    exchanges = [one for one in read_trace(result.folder / FILE) if isinstance(one, TracedExchange)]
    assert not [one.what for one in exchanges if one.command]


# makers C1: the scan of 8 s ended by itself, which passed as a stop
def test_stop_without_effect_is_found_and_the_report_ends_with_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scans, "STOPPED_REAL_S", 8.0)
    person = Person()
    result = commissioned(tmp_path, "Nanonis", person, patience=1.0, controller='as_reported = ["deaf-stop"]\n')
    found = result.progress.results["stop"]
    assert found.outcome is CheckOutcome.FAILED, found
    assert re.search(r"expected SS_FREE within .* s of stop-scan; came .* s, of a scan of 160 s", found.line)
    assert any("Do not leave this controller alone" in line for line in person.shown)
    logged = InstrumentReport.read(tmp_path / "report.toml").logged
    assert any("the measurement is in the air (" in line for line in logged), "once, with a count"
    assert [line for line in person.shown if line.startswith("logged: ")] == [f"logged: {line}" for line in logged]


def test_withdrawal_without_effect_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    person = Person()
    result = commissioned(tmp_path, "Nanonis", person, "spoiled.DeafNanonis")
    assert not result.passed
    assert "z counts the other way at this rig" in result.progress.results["x-retract"].line
    assert result.claims["withdrawn-limit"] == "does not hold"
    assert any("THE TIP WAS NOT WITHDRAWN" in line for line in person.shown)
    report = InstrumentReport.read(tmp_path / "report.toml")
    assert report.steps["x-retract"]["outcome"] == "mismatch"
    assert report.claims["withdrawn-limit"] == maker_claims.FALSE


def test_lines_that_never_come_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    result = commissioned(tmp_path, "Nanonis", Person({"Is the tip at the sample": False}), "spoiled.NoLinesNanonis")
    lines = result.progress.results["lines"]
    assert (lines.outcome, lines.line[:40]) == (CheckOutcome.SKIPPED, "no line came while the scan ran: the log")
    log = (result.folder / "log.txt").read_text(encoding="utf-8")
    assert log.count("no more lines of this scan are published") == 1


@not_on_wine("a process can't be stopped and continued there")
def test_a_lost_connection_is_noticed_and_found_again(tmp_path: Path) -> None:
    def pid() -> int:
        (run,) = (tmp_path / "runs").glob("test-*")
        told = re.search(r"controller listens at 127.0.0.1:(\d+)", (run / "log.txt").read_text(encoding="utf-8"))
        assert told
        (found,) = [
            child.pid
            for child in psutil.Process().children(recursive=True)
            if any(one.laddr.port == int(told[1]) and one.status == "LISTEN" for one in child.net_connections())
        ]
        return int(found)

    def end() -> str:
        freeze(pid())
        return ""

    def restore() -> str:
        os.kill(pid(), signal.SIGCONT)
        return ""

    says: dict[str, str | bool | Callable[[], str]] = {
        "End the connection": end,
        "Restore the connection": restore,
        "Is the tip at the sample": False,
    }
    result = commissioned(tmp_path, "Nanonis", Person(says))
    assert result.progress.results["connection"].outcome is CheckOutcome.PASSED, (result.progress.results, result.lost)


def ask(folder: Path, driver: str, *answers: str) -> subprocess.CompletedProcess[str]:
    shutil.copy(HERE / "spoiled.py", folder)
    (folder / "experiment.toml").write_text(
        EXPERIMENT.format(vendor="Nanonis", driver=driver, controller=""), encoding="utf-8"
    )
    return subprocess.run(
        [sys.executable, "-c", "from afspm.cli import main; main()", "commission", "experiment.toml"],
        input="\n".join(answers) + "\n",
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        encoding="utf-8",
        timeout=DEADLINE_S,
        check=False,
    )


def test_the_command_asks_and_reports(tmp_path: Path) -> None:
    # controller, withdrawn, frame, angle, scan, lines and stop; the tip stays away
    done = ask(tmp_path, "Nanonis", *["y"] * 7, "n")
    assert done.returncode == 1, done.stdout + done.stderr  # the tip was not approached
    assert "✓ Stopping a scan" in done.stdout
    assert "– declined: The tip is at the sample" in done.stdout
    report = InstrumentReport.read(tmp_path / "experiment-commissioning.toml")
    assert report.operations["scan"] == "passed"
    assert report.operations["axes"] == "blocked"
    assert report.claims["grabbed-rows"] == "holds"
    assert report.claims["angle-clockwise"] == "not shown", "an emulator has no panel that shows it"
    sent = tmp_path / "experiment-commissioning-to-send"
    files = {"README.md", "report.toml", "timings.csv", "versions.json", "in-the-air.nc"}
    assert {file.name for file in sent.iterdir()} == files
    for step in ("panel", "stop-at-panel", "connection"):
        assert report.steps[step] == {"outcome": "skipped", "line": f"{NO_PANEL} or cable"}
    assert f"Where to, in the panel's picture? – skipped: {NO_PANEL}" in done.stdout


def test_a_rehearsal_is_patient_with_a_busy_computer(tmp_path: Path) -> None:
    # the end is noticed 6 s late, as on a computer that is ten times slower
    done = ask(tmp_path, "spoiled.LateEndNanonis", *["y"] * 5, "n")
    assert "✓ A scan, and its end" in done.stdout, done.stdout + done.stderr


def test_the_end_of_the_answers_ends_it_safely(tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT.format(vendor="Gxsm", driver="Gxsm", controller=""), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", "from afspm.cli import main; main()", "commission", "experiment.toml"],
        input="y\n",
        cwd=tmp_path,
        capture_output=True,
        encoding="utf-8",
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 130, done.stdout + done.stderr
    assert InstrumentReport.read(tmp_path / "experiment-commissioning.toml").steps["controller"]["outcome"] == "passed"


@can_interrupt
def test_ctrl_c_at_a_question_ends_it_with_the_report_written(tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT.format(vendor="Nanonis", driver="Nanonis", controller=""), encoding="utf-8")
    command = [sys.executable, "-c", "from afspm.cli import main; main()", "commission", "experiment.toml"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=tmp_path, stdin=pipe, stdout=pipe, encoding="utf-8") as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write("y\n")
        process.stdin.flush()
        said = ""
        while not said.endswith("scanner can't reach it? [y/N] "):
            said += (one := process.stdout.read(1))
            assert one, said
        interrupt(process)
        process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 130
    report = InstrumentReport.read(tmp_path / "experiment-commissioning.toml")
    assert report.steps["controller"]["outcome"] == "passed"
    assert not report.unrestored


def address(folder: Path) -> str:
    """Return the address of the emulated controller."""
    (run,) = (folder / "runs").glob("test-*")
    found = re.search(
        r"controller listens at (?:tcp://)?(127.0.0.1:\d+)", (run / "log.txt").read_text(encoding="utf-8")
    )
    assert found
    return found[1]


@pytest.mark.parametrize("vendor", ["Nanonis", "Asylum", "Nanosurf"])
def test_a_scan_that_the_person_stops_at_the_panel_ends_no_control(vendor: str, tmp_path: Path) -> None:
    def do(function: str, *arguments: str | int) -> Callable[[], str]:
        def press() -> str:
            at = address(tmp_path)
            if vendor == "Asylum":
                igor = asylum.Link(f"tcp://{at}", DEADLINE_S, time.monotonic)
                igor.ask(function, *arguments)
                igor.close()
            elif vendor == "Nanosurf":
                at_studio(at, "imaging.stop")
            else:
                link = nanonis.Link(("127.0.0.1", int(at.rpartition(":")[2])), DEADLINE_S, time.monotonic)
                link.ask(function, *arguments)
                link.close()
            return ""

        return press

    stop = do("DoScanFunc", "StopScan") if vendor == "Asylum" else do("Scan.Action", 1, 0)
    # Asylum's stop also withdraws the tip
    person = Person({"Stop the scan at the panel, then": stop, "approach at the panel": do("SimpleEngageMe", "Engage")})
    result = commissioned(tmp_path, vendor, person)
    lines = {name: f"{one.outcome.value}: {one.line}" for name, one in result.progress.results.items()}
    assert lines["stop-at-panel"] == "passed: noticed, and no scan was published", lines
    assert result.passed, (result.lost, lines)


def at_studio(at: str, command: str) -> None:
    """Press a button of the emulated Studio."""
    studio = nanosurf.Link(at, DEADLINE_S, time.monotonic)
    try:
        (sessions,) = studio.run("root.session.select_main(0) return root.session.list()")
        studio.run(f'return root.session.select("{sessions[1]}", 1)')
        studio.run(f"root.workflow.{command}() return 0")
    finally:
        studio.close()


# makers C2: Studio shows nothing of it
def test_tip_of_nanosurf_withdrawn_when_the_step_asks_for_it_breaks_nothing_off(tmp_path: Path) -> None:
    questions: list[str] = []

    def withdraw() -> str:
        questions.append("withdraw")
        at_studio(address(tmp_path), "approach.withdraw")
        return "y"

    person = Person({"scanner can't reach it": withdraw, "Is the tip at the sample": False})
    result = commissioned(tmp_path, "Nanosurf", person)
    lines = {name: f"{one.outcome.value}: {one.line}" for name, one in result.progress.results.items()}
    assert not result.lost
    assert questions == ["withdraw"]
    assert lines["withdrawn"].startswith("passed: on your word alone: "), lines
    assert lines["stop"].startswith("passed"), lines


def at_nanonis(folder: Path, function: str, *arguments: object) -> tuple[Any, ...]:
    """Call a function of the emulated controller, as its panel does."""
    link = nanonis.Link(("127.0.0.1", int(address(folder).rpartition(":")[2])), DEADLINE_S, time.monotonic)
    try:
        return link.ask(function, *arguments)
    finally:
        link.close()


def test_claims_about_nanonis_are_settled_with_the_tip_withdrawn(tmp_path: Path) -> None:
    def continuous() -> str:
        _, _, _, series, comment, modules, _, _, paste = at_nanonis(tmp_path, "Scan.PropsGet")
        on, all_saved = 1, 1
        at_nanonis(tmp_path, "Scan.PropsSet", on, 0, all_saved, series, comment, modules, paste)
        return "y"

    person = Person({"Switch *continuous* on": continuous, "Go through": False, "Is the tip at the sample": False})
    result = commissioned(tmp_path, "Nanonis", person)
    assert {name for name, verdict in result.claims.items() if verdict == "holds"} == {
        "angle-clockwise", "y-up", "continuous-off", "grabbed-rows", "grabbed-backward", "buffer-numbers", "safe-tip",
    }  # fmt: skip
    assert InstrumentReport.read(tmp_path / "report.toml").claims == result.claims
    assert any("WARNING: the safe tip is off" in line for line in person.shown)
    assert result.progress.results["safe-tip"].line == "OFF (its threshold: 1 nA)"


def test_hands_at_the_panel_settle_how_the_program_behaves_by_itself(tmp_path: Path) -> None:
    def move() -> str:
        x, y, width, height, angle = at_nanonis(tmp_path, "Scan.FrameGet")
        at_nanonis(tmp_path, "Scan.FrameSet", x + width / 4, y, width, height, angle)
        return ""

    def pause() -> str:
        at_nanonis(tmp_path, "Scan.Action", 2, 0)
        return ""

    says: dict[str, str | bool | Callable[[], str]] = {
        "Move the frame at the panel, then": move,
        "go on at the new place": "yes",
        "Pause the scan at the panel, then": pause,
        "Does it show 96": "unseen",
        "Is it refused": "no",
        "Is the tip at the sample": False,
    }
    person = Person(says)
    result = commissioned(tmp_path, "Nanonis", person)
    lines = {name: f"{one.outcome.value}: {one.line}" for name, one in result.progress.results.items()}
    assert lines["frame-in-scan"] == "passed: no scan was published"
    assert lines["pause-at-panel"].startswith("passed: ")
    assert lines["looks"] == "passed: 5 of 6 were answered"
    of = ("frame-in-scan", "paused-as-ended", "pixels-of-16", "frame-bounds", "qplus-names")
    assert [result.claims[name] for name in of] == [
        "holds", "holds" if "taken for ended" in lines["pause-at-panel"] else "does not hold", "not shown",
        "does not hold", "holds",
    ]  # fmt: skip


def test_feedback_switched_at_the_panel_is_read(tmp_path: Path) -> None:
    def switch(on: int) -> Callable[[], str]:
        def press() -> str:
            igor = asylum.Link(f"tcp://{address(tmp_path)}", DEADLINE_S, time.monotonic)
            igor.ask("AfspmFeedback", on)
            igor.close()
            return ""

        return press

    person = Person({"feedback off at": switch(0), "feedback on at": switch(1), "Is the tip at the sample": False})
    result = commissioned(tmp_path, "Asylum", person)
    assert result.progress.results["feedback-at-panel"].line == "read as the panel switches it", result.progress.results
    assert result.claims["feedback-on"] == "holds"


def test_person_may_leave_out_what_only_claims_need(tmp_path: Path) -> None:
    result = commissioned(tmp_path, "Nanonis", Person({"Go through them?": False, "Is the tip at the sample": False}))
    left = {name for name, one in result.progress.results.items() if one.line == "left out"}
    assert left == {"connection", "frame-in-scan", "pause-at-panel", "looks"}


def test_noise_of_a_reading_proposes_a_line_for_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    person = Person({"scanner can't reach it": False})
    result = commissioned(tmp_path, "Nanonis", person, "spoiled.NoisyNanonis")
    assert "not steady: tip-bias-voltage by 2 mV" in result.progress.results["noise"].line
    assert any('[microscope.parameters.tip-bias-voltage]\n  resolution = "4 mV"' in line for line in person.shown)


@pytest.mark.parametrize("resolution", ["20 pm", "20 nm"])
def test_feedback_switched_off_and_on_shows_how_z_stands(resolution: str, tmp_path: Path) -> None:
    settings = f'[microscope.parameters.x-tip-z]\nresolution = "{resolution}"\n'
    person = Person()
    result = commissioned(tmp_path, "Nanonis", person, settings=settings, only="held-z")
    line = result.progress.results["held-z"].line
    if resolution == "20 pm":  # particles under a fast feedback: z is noisy
        assert "with the feedback on" in line
        assert any("[microscope.parameters.x-tip-z]" in one for one in person.shown)
    else:
        assert re.fullmatch(r"z moved by .*m while it was off, and by .*m once it was on again", line), line


# nanonis 5
def test_wrong_order_of_rows_in_memory_is_found_while_a_scan_fills(tmp_path: Path) -> None:
    person = Person({"Is the tip at the sample": False})
    result = commissioned(tmp_path, "Nanonis", person, settings='grabbed_rows = "recorded"\n')
    assert result.progress.results["lines"].outcome is CheckOutcome.FAILED
    assert "in other rows" in result.progress.results["lines"].line
    assert (result.claims["grabbed-rows"], result.claims["buffer-numbers"]) == ("does not hold", "not shown")


def test_frame_that_the_person_has_set_at_the_panel_stays(tmp_path: Path) -> None:
    def set_frame() -> str:
        at_nanonis(tmp_path, "Scan.FrameSet", 1e-7, 0.0, 6e-7, 4e-7, 20.0)
        return ""

    person = Person({"when the frame is set": set_frame, "scanner can't reach it": False})
    result = commissioned(tmp_path, "Nanonis", person)
    assert result.progress.results["withdrawn"].outcome is CheckOutcome.DECLINED
    assert not InstrumentReport.read(tmp_path / "report.toml").unrestored
    exchanges = [one for one in read_trace(result.folder / FILE) if isinstance(one, TracedExchange)]
    assert [one.what for one in exchanges if one.command] == []


def test_safe_tip_that_is_on_is_reported_with_its_threshold(tmp_path: Path) -> None:
    def switch_on() -> str:
        at_nanonis(tmp_path, "SafeTip.OnOffSet", 1)
        return "y"

    person = Person({"Is this the controller": switch_on, "scanner can't reach it": False})
    result = commissioned(tmp_path, "Nanonis", person)
    assert result.progress.results["safe-tip"].line == "on, at 1 nA"
    assert not any("WARNING" in line for line in person.shown if not line.startswith("logged: "))
    assert result.claims["grabbed-rows"] == "not shown"
    assert not InstrumentReport.read(tmp_path / "report.toml").unrestored


# makers C2: "control was lost: translator_test is not in control"
def test_tip_withdrawn_at_the_panel_when_the_step_asks_for_it_lets_the_evening_go_on(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "afspm", "emulate", "nanonis", "withdrawn=false", "--port", "0", "-o", "files"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, encoding="utf-8") as emulator:
        try:
            assert emulator.stdout is not None
            listens = re.search(r"127\.0\.0\.1:(\d+)", emulator.stdout.readline())
            assert listens
            link = nanonis.Link(("127.0.0.1", int(listens[1])), DEADLINE_S, time.monotonic)
            questions = 0

            def withdraw() -> str:
                nonlocal questions
                questions += 1
                if questions == 1:
                    link.ask("ZCtrl.Withdraw", 1, -1)
                return "y"

            experiment = tmp_path / "experiment.toml"
            at = f'[microscope]\ncomponent = true\nclass = "Nanonis"\naddress = "127.0.0.1:{listens[1]}"\n'
            experiment.write_text(at, encoding="utf-8")
            agrees = iter("yyyn")  # to the frame, its turn and a scan in the air
            says: dict[str, str | bool | Callable[[], str]] = {"Shall afspm do this now": lambda: next(agrees, "n")}
            person = Person(says | {"scanner can't reach it": withdraw})
            options = CheckOptions([experiment], runs=tmp_path / "runs", patience=REHEARSAL_PATIENCE)
            result = commission(options, person, tmp_path / "report.toml", "emulator", has_panel=True)
            link.close()
        finally:
            emulator.kill()
    assert not result.lost
    found = result.progress.results["withdrawn"]
    assert found.line.startswith("confirmed: x-engaged reads false"), person.shown
    assert result.progress.results["scan"].outcome is CheckOutcome.PASSED
    assert sum("Is this the controller in front" in line for line in person.shown) == 1, "no passed step is repeated"
    assert not any("not put back" in line for line in person.shown)


# makers Z3
@pytest.mark.parametrize("step", ["axes", "moved-frame"])
def test_simulator_of_gxsm_is_excused_its_picture(step: str, tmp_path: Path, spoiled: None) -> None:
    fast = "pixels_per_s = 1000\n"
    gxsm = "spoiled.SimulatingGxsm"
    result = commissioned(tmp_path, gxsm, Person(), "Gxsm", controller=fast, only=step)
    found = result.progress.results[step]
    assert found.outcome is CheckOutcome.SKIPPED, found
    assert found.line.startswith("GXSM's simulator turns its picture against the direction")


# makers Z4
def test_scan_to_be_stopped_at_the_panel_is_long_without_a_scan_speed(tmp_path: Path, spoiled: None) -> None:
    person = Person()
    emulator = "spoiled.SimulatingGxsm"
    commissioned(tmp_path, emulator, person, "Gxsm", controller="pixels_per_s = 80\n", only="stop-at-panel")
    (lasts,) = filter(None, (re.search(r"The scan lasts about (\d+) s", line) for line in person.shown))
    assert int(lasts[1]) >= STOPPED_REAL_S


# users U15
@pytest.mark.parametrize(
    ("vendor", "fault", "said"),
    [
        ("Nanonis", "x mirrored", "came x is mirrored$"),
        ("Nanosurf", "y mirrored", "came y is mirrored$"),
        ("Nanonis", "swapped", "came x and y are swapped$"),
        ("Nanosurf", "scale", r"scale is wrong along x: a move of 1 shows as 0.9\d; .* along y: .* as 0.9\d$"),
        ("Nanonis", "scale of y", r"came the scale is wrong along y: a move of 1 shows as 1.1\d$"),
        ("Nanosurf", "angle", r"came the angle is wrong: the picture is turned by \+[45]\.\d deg from x, "),
        ("Nanonis", "other way", r"came the angle is wrong: a frame turned by 20 deg is turned by -(19|20)\.\d deg$"),
    ],
)
def test_frame_that_is_moved_alone_shows_its_fault(
    vendor: str, fault: str, said: str, tmp_path: Path, spoiled: None
) -> None:
    emulator, controller = f"spoiled.Wrong{vendor}", f'fault = "{fault}"\n'
    result = commissioned(tmp_path, emulator, Person(), vendor, controller=controller, only="moved-frame", frame_m=8e-7)
    found = result.progress.results["moved-frame"]
    assert found.outcome is CheckOutcome.FAILED, found
    assert re.search(said, found.line), found.line
    assert InstrumentReport.read(tmp_path / "report.toml").steps["moved-frame"]["line"] == found.line
    assert list(result.progress.results) == ["controller", "contact", "moved-frame"]


def test_step_that_does_not_exist_is_refused_with_the_names_of_all(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"there is no step 'frames'.*moved-frame"):
        commissioned(tmp_path, "Nanonis", Person(), only="frames")
