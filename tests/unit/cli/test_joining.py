"""Messages of the terminal's commands if no experiment runs."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path

import pytest
import typer
from published_schemas import require_valid
from typer.testing import CliRunner

from afspm.cli.app import app
from afspm.cli.joining import NOT_RUNNING, looking, plain_console, say_unanswered
from afspm.record.run_lock import cut_off_message, describe_state, lock_run


@pytest.mark.parametrize("runs", [False, True], ids=["cut off", "it runs"])
@pytest.mark.parametrize("keys", ["null", '{"folder": "keys"}'])
def test_message_on_a_run_that_was_cut_off_names_resume_and_on_a_running_one_the_likely_fault(
    keys: str, runs: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "night-1" / "state").mkdir(parents=True)
    (tmp_path / "night-1" / "run.json").write_text(
        f'{{"name": "night", "guest": {{"keys": {keys}}}}}', encoding="utf-8"
    )
    with lock_run(tmp_path / "night-1"):
        pass
    held = lock_run(tmp_path / "night-1") if runs else nullcontext()
    with held, pytest.raises(typer.Exit):
        say_unanswered(tmp_path / "night-1")
    said = capsys.readouterr().err
    assert "no scheduler answers in night-1" in said
    assert (f"it was cut off; `afspm run --resume {tmp_path / 'night-1'}` goes on with it" in said) is not runs
    assert ("though it has not ended" in said) is runs
    assert ("lacks the public key of terminal" in said) is (runs and keys != "null")


def a_run(runs: Path, name: str, **facts: str) -> Path:
    (runs / name / "state").mkdir(parents=True)
    (runs / name / "run.json").write_text(json.dumps({"name": "night", **facts}), encoding="utf-8")
    (runs / "latest.txt").write_text(name, encoding="utf-8")
    return runs / name


@pytest.mark.parametrize("named", ["runs", "night.toml"])
@pytest.mark.parametrize("command", ["pause", "continue", "end", "note"])
def test_command_that_acts_refuses_several_running_experiments(
    command: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("night.toml").write_text('name = "night"\n', encoding="utf-8")
    runs = Path("runs")
    arguments = [command, named, "the tip is new"] if command == "note" else [command, named]
    with lock_run(a_run(runs, "night-0")):
        pass  # was cut off
    with lock_run(a_run(runs, "night-1")), lock_run(a_run(runs, "night-2")):
        result = CliRunner().invoke(app, arguments)
    assert "several experiments run here, night-" in str(result.exception)
    assert "night-0" not in str(result.exception)
    assert "name the folder of the one that you mean, for example " in str(result.exception)


def test_command_that_looks_says_which_of_several_experiments_it_shows(tmp_path: Path) -> None:
    with lock_run(a_run(tmp_path, "night-1")), lock_run(a_run(tmp_path, "night-2")):
        result = CliRunner().invoke(app, ["status", str(tmp_path)])
    assert f"several experiments run here, night-1 and night-2: this is {tmp_path / 'night-2'}" in result.stderr


@pytest.mark.parametrize(
    ("facts", "how"), [({"ended": "all plans are done"}, "has ended (all plans are done)"), ({}, "was cut off")]
)
def test_command_names_the_run_that_goes_on_beside_a_newest_run_that_is_over(
    facts: dict[str, str], how: str, tmp_path: Path
) -> None:
    with lock_run(a_run(tmp_path, "night-1")):
        with lock_run(a_run(tmp_path, "test-2", **facts)):
            pass
        result = CliRunner().invoke(app, ["pause", str(tmp_path)])
    assert result.exit_code == NOT_RUNNING
    assert f"test-2 {how}; {tmp_path / 'night-1'} goes on: name its folder" in result.output


def test_command_in_the_first_second_of_a_run_says_when_to_repeat_it(tmp_path: Path) -> None:
    (a_run(tmp_path, "night-1") / "run.json").unlink()
    result = CliRunner().invoke(app, ["pause", str(tmp_path)])
    assert result.exit_code == NOT_RUNNING
    assert "night-1 has no run.json: it is about to start: repeat the command in a few seconds" in result.output


@pytest.mark.parametrize("command", ["status", "problems"])
def test_program_learns_that_a_run_has_ended(command: str, tmp_path: Path) -> None:
    folder = tmp_path / "night-1"
    folder.mkdir()
    (folder / "run.json").write_text('{"name": "night", "ended": "all plans are done"}', encoding="utf-8")
    result = CliRunner().invoke(app, [command, str(folder), "--json"])
    told = json.loads(result.stdout)
    require_valid(command, told)
    assert (result.exit_code, told["running"]) == (NOT_RUNNING, False)
    assert "night-1 has ended (all plans are done)" in told["why"]


def test_run_of_another_computer_is_not_called_cut_off(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "night-1"
    (folder / "state").mkdir(parents=True)
    (folder / "run.json").write_text('{"name": "night", "computer": "lab-7", "guest": {}}', encoding="utf-8")
    with lock_run(folder):
        pass
    assert cut_off_message(folder) == ""
    assert describe_state(folder) == "it goes on, or was cut off; lab-7, on which it was started, knows"
    with pytest.raises(typer.Exit):
        say_unanswered(folder)
    assert "night-1 was started on lab-7, and does not answer to this computer" in capsys.readouterr().err


def test_ended_run_is_named_from_its_folder_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "night-1"
    folder.mkdir()
    (folder / "run.json").write_text('{"ended": "the experiment has ended"}', encoding="utf-8")
    monkeypatch.chdir(folder)
    with pytest.raises(typer.Exit) as exit, looking(Path()):
        pass
    assert exit.value.exit_code == NOT_RUNNING
    assert "night-1 has ended (the experiment has ended)" in capsys.readouterr().err


def test_output_to_a_file_is_not_wrapped(capsys: pytest.CaptureFixture[str]) -> None:
    text = 100 * "word "
    plain_console().print(text)
    assert capsys.readouterr().out == text + "\n"
