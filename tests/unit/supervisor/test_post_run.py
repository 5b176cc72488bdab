"""Notification, report and summary after the end of a run."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from deadlines import DEADLINE_S

from afspm.basics.clock import ExperimentClock
from afspm.components import notifications
from afspm.components.notifications import OCCASIONS, Targets
from afspm.experiment import load
from afspm.record.store import RecordStore
from afspm.report.night_report import REPORT_FILE
from afspm.supervisor import post_run
from afspm.supervisor.ports import FreePorts
from afspm.supervisor.post_run import EndedRun
from afspm.supervisor.supervision.run_end import EndReason
from afspm.supervisor.supervision.supervised_child import ProcessReport
from afspm.supervisor.supervisor import RunOutcome


class Log:
    """Stores the written lines."""

    def __init__(self) -> None:
        self.lines: list[tuple[int, str]] = []

    def write(self, name: str, level: int, text: str) -> None:
        self.lines.append((level, text))


def told(folder: Path, why: EndReason, on: tuple[str, ...] = OCCASIONS) -> list[dict[str, object]]:
    """Return the notification that a command gets about a run with this end."""
    file = folder / "told.txt"
    code = "import sys; open(sys.argv[1], 'a').write(sys.stdin.read() + chr(10))"
    reports = (ProcessReport("judge", 3, True, "exit code 1"), ProcessReport("series", 1, False, "done"))
    outcome = RunOutcome(why, "the microscope is given up", reports, 60.0)
    targets = Targets([sys.executable, "-c", code, str(file)])
    post_run.tell(EndedRun("night", folder, outcome, True), targets, on, ExperimentClock.real(), Log())  # type: ignore[arg-type]
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


@pytest.mark.parametrize(
    ("why", "on", "what"),
    [
        (EndReason.EXPERIMENT_ENDED, OCCASIONS, "end"),
        (EndReason.STOPPED, ("end",), "end"),
        (EndReason.LOST, OCCASIONS, "given-up"),
        (EndReason.LOST, ("end",), "end"),
    ],
)
def test_notification_of_the_end_has_its_reason(tmp_path: Path, why: EndReason, on: tuple[str, ...], what: str) -> None:
    (notice,) = told(tmp_path, why, on)
    assert (notice["what"], notice["experiment"], notice["run"]) == (what, "night", str(tmp_path))
    assert notice["text"] == "the microscope is given up; given up: judge"


def test_end_is_not_notified_unless_chosen(tmp_path: Path) -> None:
    assert told(tmp_path, EndReason.EXPERIMENT_ENDED, ("unsolved-problem",)) == []


class TenSeconds:
    """A clock on which each attempt takes ten seconds."""

    def __init__(self) -> None:
        self.t_s = -10.0

    def monotonic_s(self) -> float:
        self.t_s += 10.0
        return self.t_s

    def now_ns(self) -> int:
        return 0


def test_failed_notification_is_retried_then_abandoned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(notifications, "FIRST_DELAY_S", 0.01)
    log, count = Log(), tmp_path / "count"
    code = "import sys; open(sys.argv[1], 'a').write('x'); sys.exit('no network')"
    ended = EndedRun("night", tmp_path, RunOutcome(EndReason.ALL_DONE, "all components are done", (), 1.0), False)
    targets = Targets([sys.executable, "-c", code, str(count)])
    post_run.tell(ended, targets, ("end",), TenSeconds(), log)  # type: ignore[arg-type]
    assert count.read_text() == "xxx"
    assert [level for level, _ in log.lines] == [logging.ERROR]
    assert "the command failed" in log.lines[0][1]


def test_the_report_is_written_by_another_process(tmp_path: Path) -> None:
    RecordStore(tmp_path).close()
    log = Log()
    post_run.report(tmp_path, log)  # type: ignore[arg-type]
    assert (tmp_path / REPORT_FILE).is_file()
    assert log.lines[-1] == (logging.INFO, f"the report is {tmp_path / REPORT_FILE}")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no FIFOs")
@pytest.mark.parametrize("works", [True, False])
def test_report_is_given_up_only_if_its_process_does_not_work(works: bool, tmp_path: Path) -> None:
    RecordStore(tmp_path).close()
    gate, used_s = tmp_path / "gate", [0.0]
    os.mkfifo(gate)

    def processor_s(_: int) -> float:
        if works:
            used_s[0] += 1.0
        if used_s[0] == 3.0:
            gate.write_bytes(b"")  # the process, which waits for this, ends now
        return used_s[0]

    waiting = [sys.executable, "-c", f"open({str(gate)!r}).read()"]
    log = Log()
    post_run.report(tmp_path, log, command=waiting, stalled_s=0.05, processor_s=processor_s)  # type: ignore[arg-type]
    level, text = log.lines[-1]
    assert (level == logging.INFO) is works
    assert ("has not worked for" in text) is not works


@pytest.mark.skipif(sys.platform == "win32", reason="Windows ends a process without a signal")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signal_in_the_report_leaves_the_command_that_writes_it(number: int, tmp_path: Path) -> None:
    # spectra, "small list": SIGTERM in the report left no word
    RecordStore(tmp_path).close()
    # nohup, for example, ignores SIGHUP
    code = f"""
import logging, signal, sys, threading
from pathlib import Path
signal.signal({number}, signal.default_int_handler if {number} == signal.SIGINT else signal.SIG_DFL)
from afspm.supervisor import post_run

class Log:
    def write(self, name, level, text):
        print(text, flush=True)

post_run.python_command = lambda _: [sys.executable, "-c", "import time; print('x'); time.sleep(600)"]
post_run.report(Path({str(tmp_path)!r}), Log())
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "writing the report …\n"
        children: list[psutil.Process] = []
        while not any("sleep" in str(child.cmdline()) for child in children):  # it is a program, and no fork any more
            children = psutil.Process(process.pid).children()
        process.send_signal(number)
        said, _ = process.communicate(timeout=DEADLINE_S)
    name = signal.Signals(number).name
    assert said == f"no report: {name} came while it was written; `afspm report {tmp_path}` writes it\n"
    assert process.returncode == -number
    psutil.wait_procs(children, timeout=DEADLINE_S)
    assert not any(child.is_running() for child in children)
    assert not (tmp_path / REPORT_FILE).exists()


def test_run_without_a_record_has_no_report_and_no_warning(tmp_path: Path) -> None:
    log = Log()
    post_run.report(tmp_path, log)  # type: ignore[arg-type]
    assert log.lines == []
    assert list(tmp_path.iterdir()) == []


def test_a_report_that_fails_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "journal.sqlite").write_bytes(b"not a database at all, but long enough to be looked at" * 20)
    log = Log()
    post_run.report(tmp_path, log)  # type: ignore[arg-type]
    level, text = log.lines[-1]
    assert level == logging.WARNING
    assert text.startswith("no report: ")


def test_notification_precedes_the_report(tmp_path: Path) -> None:
    """The report may take two minutes, and a person may press Ctrl-C before."""
    RecordStore(tmp_path).close()
    code = "import os, sys; open(sys.argv[2], 'w').write(str(os.path.exists(sys.argv[1])))"
    command = [sys.executable, "-c", code, str(tmp_path / REPORT_FILE), str(tmp_path / "told.txt")]
    file = tmp_path / "experiment.toml"
    parts = [f'[{name}]\ncomponent = true\nclass = "{name.capitalize()}"\n' for name in ("simulator", "scheduler")]
    file.write_text("\n".join([*parts, f"[notify]\ncommand = {json.dumps(command)}\n"]))
    experiment = load(file)
    starts = experiment.launches(take_address=FreePorts().address)
    ended = EndedRun("night", tmp_path, RunOutcome(EndReason.ALL_DONE, "all components are done", (), 1.0), True)
    post_run.follow(experiment, ended, starts, ExperimentClock.real(), Log(), with_report=True)  # type: ignore[arg-type]
    assert (tmp_path / "told.txt").read_text() == "False"
    assert (tmp_path / REPORT_FILE).exists()
