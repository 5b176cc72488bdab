"""Notifications: when, once, retried after failures, and without revealing secrets."""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from client_lab import FakeClock
from deadlines import DEADLINE_S
from typer.testing import CliRunner

from afspm import model
from afspm.basics.errors import ConfigError
from afspm.cli.app import app
from afspm.components import notifications, notifier
from afspm.components.notifications import NotDelivered, Notification, Targets
from afspm.components.notifier import Notifier
from afspm.model import ControlMode, ControlState, ProblemNames, ProcessCondition
from afspm.model.events import LogLines
from afspm.storage.memory import Memory

SECRET = "T0PSECRET"
NOTICE = Notification(
    "end", "night", "runs/night-1", 1_700_000_000_000_000_000, "the experiment has ended", simulated=True
)


class Hook(ThreadingHTTPServer):
    """A server that stores each POST, and answers with `codes` in turn (repeating the last)."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.codes = [200]
        self.got: list[dict[str, object]] = []
        self.pings: list[tuple[str, dict[str, str], bytes]] = []
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/hooks/{SECRET}"


class _Handler(BaseHTTPRequestHandler):
    server: Hook

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        code = self.server.codes.pop(0) if len(self.server.codes) > 1 else self.server.codes[0]
        if code == 200:
            self.server.got.append(body)
        self.send_response(code)
        if 300 <= code < 400:
            self.send_header("Location", self.path)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def do_GET(self) -> None:
        code = self.server.codes.pop(0) if len(self.server.codes) > 1 else self.server.codes[0]
        self.server.pings.append(
            (self.path, dict(self.headers), self.rfile.read(int(self.headers.get("Content-Length", 0))))
        )
        self.send_response(code)
        if 300 <= code < 400:
            self.send_header("Location", self.path)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def hook() -> Iterator[Hook]:
    server = Hook()
    yield server
    server.shutdown()
    server.server_close()


class Night:
    """A notifier in an experiment: its lives share clock and memory."""

    def __init__(self, folder: Path, **settings: object) -> None:
        self.folder, self.settings, self.clock = folder, settings, FakeClock()
        (folder / "run.json").write_text('{"name": "night"}', encoding="utf-8")
        self.start()

    def start(self) -> None:
        class Scope:
            problems = ProblemNames()

        self.notifier = Notifier(**self.settings)  # type: ignore[arg-type]
        self.notifier.name = "notifier"
        self.notifier.clock, self.notifier.log = self.clock, logging.getLogger("afspm.notifier")
        self.notifier.memory = Memory(self.folder / "notifier.json")
        self.notifier.run_dir, self.notifier.simulated, self.notifier.packet = self.folder, True, None
        self.notifier.scope = Scope()  # type: ignore[assignment]
        self.notifier.on_start()

    def control(self, *problems: int) -> None:
        self.notifier.on_control(ControlState(ControlMode.AUTOMATED, None, problems))

    def given_up(self, name: str, last_exit: str = "") -> None:
        state = model.ProcessState(name, "component", ProcessCondition.GIVEN_UP, 1, 0.0, 3, 0, last_exit)
        self.notifier.on_process_states(model.ProcessStates(1, "lab", (state,)))

    def says(self, *lines: tuple[str, str, str]) -> None:
        told = (model.LogLine(1, name, level, text) for name, level, text in lines)
        self.notifier.on_log_lines(LogLines(tuple(told)))

    def passes(self, seconds: int) -> None:
        """Let time pass, with a tick every ten seconds."""
        for _ in range(seconds // 10):
            self.clock.passed_s += 10.0
            self.notifier.on_tick()


def test_unsolved_problem_is_notified_once(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, webhook=hook.url, unsolved_after=600.0)
    night.control(1)
    night.passes(590)
    assert hook.got == []
    night.passes(1000)
    (told,) = hook.got
    assert (told["what"], told["experiment"], told["run"]) == ("unsolved-problem", "night", str(tmp_path))
    assert "tip-shape-changed has been flagged for 10 min" in str(told["text"])
    assert told["simulated"] is True
    assert str(told["time"]).endswith("+00:00")


def test_problem_solved_in_time_is_not_notified(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, webhook=hook.url, unsolved_after=600.0)
    for _ in range(5):
        night.control(1)
        night.passes(590)
        night.control()
    assert hook.got == []


def test_second_problem_does_not_reset_the_time_of_the_first(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, webhook=hook.url, unsolved_after=600.0)
    night.control(1)
    night.passes(300)
    night.control(1, 4)
    night.passes(310)
    assert [str(told["text"]).split()[0] for told in hook.got] == ["tip-shape-changed"]


def test_component_given_up_is_notified_once(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, webhook=hook.url)
    for _ in range(3):  # a supervisor says so again and again
        night.given_up("judge", "exit code 1")
        night.passes(10)
    assert [told["text"] for told in hook.got] == ["judge is given up: exit code 1"]


def test_critical_line_is_notified_once(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, webhook=hook.url)
    full = ("recorder", "CRITICAL", "nothing can be recorded, the experiment goes on: No space left on device")
    night.says(("recorder", "WARNING", "it takes long"), full, ("recorder", "CRITICAL", "what belongs to it"))
    night.says(full)  # replayed
    night.passes(60)
    (told,) = hook.got
    assert (told["what"], told["text"]) == ("critical", f"recorder: {full[2]}")


def test_person_at_the_panel_is_notified_once_and_a_pause_on_request_is_not(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, webhook=hook.url)
    for number, reason in enumerate(("", "the tip was withdrawn at the microscope")):
        manual = model.JournalEntry(
            number, "control", "translator", "mode MANUAL", reason=reason, mode=ControlMode.MANUAL
        )
        for _ in range(2):  # replayed
            night.notifier.on_journal_entries(model.JournalEntries((manual,)))
    night.passes(60)
    (told,) = hook.got
    assert (told["what"], told["text"]) == (
        "by-hand",
        "the run waits for a person: the tip was withdrawn at the microscope",
    )


def test_ever_new_critical_lines_do_not_fill_the_memory(
    tmp_path: Path, hook: Hook, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(notifier, "MOST_TOLD", 3)
    night = Night(tmp_path, webhook=hook.url)
    for number in range(5):
        night.says(("microscope", "CRITICAL", f"{number} K in the cryostat"))
    assert [key.split()[2] for key in night.notifier.memory["told"]] == ["2", "3", "4"]


def test_critical_lines_of_supervisor_and_notifier_are_not_notified(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, webhook=hook.url)
    night.says(("afspm", "CRITICAL", "judge is given up"), ("notifier", "CRITICAL", "a restart would not know"))
    night.passes(60)
    assert hook.got == []


def test_only_chosen_occasions_are_notified(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, webhook=hook.url, on=["unsolved-problem"])
    night.given_up("judge")
    night.passes(100)
    assert hook.got == []


def test_failed_delivery_is_retried_with_growing_delays(tmp_path: Path, hook: Hook) -> None:
    hook.codes = [500, 503, 200]
    night = Night(tmp_path, webhook=hook.url)
    night.given_up("judge")
    night.passes(60)
    assert len(hook.got) == 1
    assert [notifications.delay_s(tries) for tries in (1, 2, 3, 20)] == [2.0, 4.0, 8.0, notifications.LONGEST_DELAY_S]


def test_delivery_that_always_fails_is_given_up_and_logged(
    tmp_path: Path, hook: Hook, caplog: pytest.LogCaptureFixture
) -> None:
    hook.codes = [500]
    night = Night(tmp_path, webhook=hook.url)
    night.given_up("judge")
    night.passes(3600)
    assert night.notifier.memory["waiting"] == []
    assert "gave up a notification: 127.0.0.1 answers 500" in caplog.text


def test_killed_notifier_continues_and_sends_nothing_twice(tmp_path: Path, hook: Hook) -> None:
    hook.codes = [500, 200]
    night = Night(tmp_path, webhook=hook.url, unsolved_after=100.0)
    night.control(1)
    night.passes(50)
    night.start()
    night.control(1)  # replayed
    night.passes(60)
    night.start()  # queued, but not delivered yet
    night.passes(60)
    night.start()
    night.control(1)
    night.passes(600)
    assert len(hook.got) == 1


def test_command_and_webhook_are_retried_separately(tmp_path: Path, hook: Hook) -> None:
    hook.codes = [500, 200]
    night = Night(tmp_path, webhook=hook.url, program=recording(tmp_path))
    night.given_up("judge")
    night.passes(100)
    assert len(hook.got) == 1
    assert len(recorded(tmp_path)) == 1


@pytest.mark.parametrize("code", [301, 302, 303, 307, 308])
def test_a_redirected_webhook_has_not_taken_the_message(hook: Hook, code: int) -> None:
    hook.codes = [code]
    with pytest.raises(NotDelivered, match=f"answers {code}, and leads to another address"):
        Targets(webhook=hook.url).deliver(NOTICE, "webhook")


def test_command_is_called_although_the_webhook_is_unknown(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    night = Night(tmp_path, webhook="$AFSPM_NO_SUCH_HOOK", program=recording(tmp_path))
    assert "only the command is called" in caplog.text
    night.given_up("judge")
    night.passes(100)
    assert len(recorded(tmp_path)) == 1
    with pytest.raises(ConfigError, match="no environment variable"):
        Night(tmp_path, webhook="$AFSPM_NO_SUCH_HOOK")


def test_no_log_holds_the_secret(tmp_path: Path, hook: Hook, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    hook.codes = [404]
    url = hook.url
    for webhook in (url, f"http://127.0.0.1:1/{SECRET}", f"http://nowhere.invalid/{SECRET}"):
        night = Night(tmp_path, webhook=webhook, program=[sys.executable, "-c", "exit(3)", SECRET])
        night.given_up(f"judge {webhook[:18]}")
        night.passes(100)
    assert "retrying" in caplog.text
    assert SECRET not in caplog.text


def recording(folder: Path) -> list[str]:
    """Return a command that writes its input to a file."""
    code = "import sys, os; open(sys.argv[1], 'a').write(sys.stdin.read() + '|' + os.environ['AFSPM_WHAT'] + chr(10))"
    return [sys.executable, "-c", code, str(folder / "told.txt")]


def recorded(folder: Path) -> list[str]:
    return (folder / "told.txt").read_text(encoding="utf-8").splitlines()


def test_a_command_gets_the_notice(tmp_path: Path) -> None:
    Targets(recording(tmp_path)).deliver(NOTICE, "command")
    body, what = recorded(tmp_path)[0].split("|")
    assert json.loads(body) == {
        "what": "end",
        "experiment": "night",
        "run": "runs/night-1",
        "time": "2023-11-14T22:13:20+00:00",
        "text": "the experiment has ended",
        "simulated": True,
    }
    assert what == "end"


@pytest.mark.parametrize(
    ("code", "said"),
    [("import sys; sys.exit('no network')", "ended with 1: no network"), ("while True: pass", "took longer")],
)
def test_failing_command_is_an_error(code: str, said: str) -> None:
    timeout_s = 0.5 if said == "took longer" else DEADLINE_S
    with pytest.raises(NotDelivered, match=said):
        Targets([sys.executable, "-c", code], timeout_s=timeout_s).deliver(NOTICE, "command")


def test_missing_program_is_an_error() -> None:
    with pytest.raises(NotDelivered, match="no-such-program can't be run"):
        Targets(["/nowhere/no-such-program"]).deliver(NOTICE, "command")


def test_a_webhook_may_be_named_by_the_environment() -> None:
    assert notifications.address("$HOOK", {"HOOK": "https://chat.example.org/x"}) == "https://chat.example.org/x"
    with pytest.raises(ConfigError, match="no environment variable 'HOOK'"):
        notifications.address("$HOOK", {})


@pytest.mark.parametrize(
    "wrong", ["ftp://a.example", "file:///etc/passwd", "chitchat", "http://", "https://u:pw@a.example"]
)
def test_invalid_address_is_refused_without_repeating_it(wrong: str) -> None:
    with pytest.raises(ConfigError) as refused:
        notifications.address(wrong)
    assert wrong not in str(refused.value)


def test_notifier_without_target_is_an_error() -> None:
    with pytest.raises(ConfigError, match="there is no recipient"):
        Notifier()
    with pytest.raises(ConfigError, match="'dawn' never happens"):
        Notifier(webhook="http://a.example", on=["dawn"])


@pytest.mark.parametrize(("code", "exit_code"), [(200, 0), (500, 1)])
def test_command_reports_whether_a_test_message_arrived(tmp_path: Path, hook: Hook, code: int, exit_code: int) -> None:
    hook.codes = [code]
    file = tmp_path / "night.toml"
    parts = "".join(f'[{n}]\ncomponent = true\nclass = "{c}"\n' for n, c in (("m", "Simulator"), ("s", "Scheduler")))
    file.write_text(f'{parts}[notify]\nwebhook = "{hook.url}"\n', encoding="utf-8")
    done = CliRunner().invoke(app, ["notify", str(file), "--test"])
    assert done.exit_code == exit_code
    assert [message["what"] for message in hook.got] == (["test"] if code == 200 else [])
    assert (
        "the webhook took the message" if code == 200 else "the webhook failed: 127.0.0.1 answers 500"
    ) in done.output
    assert SECRET not in done.output


def test_without_notify_there_is_nothing_to_test(tmp_path: Path) -> None:
    file = tmp_path / "night.toml"
    file.write_text('[m]\ncomponent = true\nclass = "Simulator"\n[s]\ncomponent = true\nclass = "Scheduler"\n')
    done = CliRunner().invoke(app, ["notify", str(file), "--test"])
    assert done.exit_code == 1
    assert "no [notify]" in done.output


def test_ping_is_a_bare_request_at_regular_times(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, ping=hook.url, every=300.0)
    night.control(1)
    night.passes(3000)
    assert len(hook.pings) == 10
    path, headers, body = hook.pings[0]
    assert (path, body) == (f"/hooks/{SECRET}", b"")
    assert headers.keys() <= {"Host", "User-Agent", "Accept-Encoding", "Connection"}
    assert headers["User-Agent"] == "afspm"
    assert hook.got == []


def test_failed_pings_are_logged_once_without_the_address(
    tmp_path: Path, hook: Hook, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "afspm.notifier")
    hook.codes = [500, 302, 500, 200, 200]
    night = Night(tmp_path, ping=hook.url, every=60.0, webhook=hook.url, on=["given-up"])
    night.passes(300)
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]
    assert SECRET not in caplog.text
    night.given_up("series")  # messages go on meanwhile
    night.passes(60)
    assert [one["what"] for one in hook.got] == ["given-up"]


def test_wrong_address_of_a_ping_leaves_the_messages(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, ping="$NO_SUCH_VARIABLE_HERE", webhook=hook.url)
    night.given_up("series")
    night.passes(60)
    assert [one["what"] for one in hook.got] == ["given-up"]
    assert hook.pings == []


def test_solved_problem_is_notified_if_it_counted_as_unsolved(tmp_path: Path, hook: Hook) -> None:
    night = Night(tmp_path, webhook=hook.url, unsolved_after=600.0, on=["unsolved-problem", "solved"])
    for lasts_s in (300, 700):
        night.control(1)
        night.passes(lasts_s)
        night.control()
        night.passes(60)
    assert [one["what"] for one in hook.got] == ["unsolved-problem", "solved"]
    assert "is solved, after 1" in str(hook.got[1]["text"])
