"""[notify]: targets and occasions of notifications."""

from __future__ import annotations

import sys

import pytest

from afspm.experiment import Experiment
from afspm.experiment.process_starts import DASHBOARD_PASSWORD
from afspm.plugins.web.dashboard.access import PASSWORD

from .conftest import Write, errors, only_error

PING = '[notify]\nping = "https://check.example.org/1"\n'
HOOK = '[notify]\nwebhook = "https://chat.example.org/hooks/1"\n'


def notifier(experiment: Experiment) -> dict[str, object]:
    assert experiment.check() == []
    addresses = (f"tcp://127.0.0.1:{port}" for port in range(21_000, 22_000))
    starts = experiment.launches(take_address=addresses.__next__)
    (start,) = [start for start in starts if start.launch.class_.endswith(".Notifier")]
    return dict(start.launch.settings)


def test_notifier_is_part_of_an_experiment_with_notify(write: Write) -> None:
    experiment = write(HOOK + 'unsolved_after = "10 min"\n')
    assert notifier(experiment)["unsolved_after"] == 600.0
    assert "notifier" in experiment.component_names


def test_ping_needs_no_other_recipient(write: Write) -> None:
    settings = notifier(write(PING + 'every = "1 min"\n'))
    assert (settings["ping"], settings["every"]) == ("https://check.example.org/1", 60.0)
    assert "webhook" not in settings


def test_experiment_without_notify_has_no_notifier(write: Write) -> None:
    assert "notifier" not in write("").component_names


def test_the_end_alone_needs_no_component(write: Write) -> None:
    experiment = write(HOOK + 'on = ["end"]\n')
    assert errors(experiment) == []
    assert "notifier" not in experiment.component_names


def test_python_is_the_running_interpreter(write: Write) -> None:
    settings = notifier(write('[notify]\ncommand = ["python", "call.py"]\n'))
    assert settings["program"] == [sys.executable, "call.py"]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("[notify]\n", "has no recipient"),
        ('[notify]\ncommand = ["no-such-program"]\n', "there is no program 'no-such-program'"),
        ('[notify]\nwebhook = "chat.example.org"\n', "it is not an address"),
        (HOOK + 'on = ["dawn"]\n', "'dawn'"),
        (HOOK + "unsolved_after = 0\n", "above 0"),
        ('[notify]\nping = "check.example.org"\n', "it is not an address"),
        (PING + "every = 5\n", "has no unit"),
        (PING + 'every = "0 s"\n', "not above zero"),
        (HOOK + 'weebhook = "x"\n', "weebhook is not a setting"),
    ],
)
def test_impossible_target_is_an_error(write: Write, wrong: str, said: str) -> None:
    assert any(said in finding.what for finding in errors(write(wrong)))


def test_an_environment_that_lacks_the_address_is_a_warning(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NIGHT_HOOK", raising=False)
    (finding,) = write('[notify]\nwebhook = "$NIGHT_HOOK"\n').check()
    assert not finding.is_error
    assert "NIGHT_HOOK" in finding.what
    monkeypatch.setenv("NIGHT_HOOK", "https://chat.example.org/hooks/1")
    assert notifier(write('[notify]\nwebhook = "$NIGHT_HOOK"\n'))["webhook"] == "$NIGHT_HOOK"


def test_an_error_does_not_repeat_an_address_that_may_be_a_secret(write: Write) -> None:
    finding = only_error(write('[notify]\nwebhook = "htps://chat.example.org/T0PSECRET"\n'))
    assert "T0PSECRET" not in str(finding)


@pytest.mark.parametrize("more", ["", 'command = ["python", "call.py"]\n'])
def test_expanded_file_with_a_notifier_round_trips(write: Write, more: str) -> None:
    experiment = write(HOOK + more)
    settings = notifier(experiment)
    again = write(experiment.expanded(), frame="")
    assert notifier(again) == settings
    assert [name for name in again.component_names if name.startswith("notifier")] == ["notifier"]


@pytest.mark.parametrize("text", [
    HOOK,
    '[notify]\nping = "https://chat.example.org/hooks/1"\n',
    'hook = "https://chat.example.org/hooks/1"\n[notify]\nwebhook = "hook"\n',
    '[caller]\ncomponent = true\nclass = "Notifier"\nwebhook = "https://chat.example.org/hooks/1"\n',
])  # fmt: skip
def test_expanded_file_in_the_run_folder_has_no_secret(
    write: Write, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    experiment = write(text)
    kept = experiment.expanded(secrets=False)
    assert "hooks/1" in experiment.expanded()
    assert "hooks/1" not in kept
    again = write(kept, frame="")
    assert any("AFSPM_WEBHOOK" in finding.what for finding in again.check()) or "caller" in text
    monkeypatch.setenv("AFSPM_WEBHOOK", "https://chat.example.org/hooks/1")
    assert not [finding for finding in write(kept, frame="").check() if finding.is_error]


def test_two_secrets_are_two_variables(write: Write) -> None:
    other = '[caller]\ncomponent = true\nclass = "Notifier"\nwebhook = "https://chat.example.org/hooks/2"\n'
    kept = write(HOOK + other).expanded(secrets=False)
    assert '"$AFSPM_WEBHOOK"' in kept
    assert '"$AFSPM_WEBHOOK_2"' in kept


def test_secrets_in_the_environment_reach_only_processes_that_need_them(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOOK", "https://chat.example.org/hooks/1")
    pages = '[page]\ncomponent = true\nclass = "Dashboard"\n'
    addresses = (f"tcp://127.0.0.1:{port}" for port in range(21_000, 22_000))
    experiment = write(HOOK.replace("https://chat.example.org/hooks/1", "$HOOK") + pages)
    starts = experiment.launches(take_address=addresses.__next__)
    hidden = {start.launch.name: start.hidden for start in starts}
    assert hidden.pop("page") == ("HOOK",)
    assert hidden.pop("notifier") == (PASSWORD,)
    assert set(hidden.values()) == {(PASSWORD, "HOOK")}
    assert DASHBOARD_PASSWORD == PASSWORD
