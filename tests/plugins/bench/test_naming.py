"""Agents and tasks by their names on the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from afspm.basics import ConfigError
from afspm_bench.agent_process import agent_of
from afspm_bench.agents import HOME, SHIPPED
from afspm_bench.bench import agent_named, agent_of_cassette, agent_of_command, tasks_named
from afspm_bench.commands import app
from afspm_bench.tasks import FAMILIES


def test_script_of_a_command_is_found_in_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my model.py").touch()
    assert agent_of_command("python3 'my model.py' --fast").command == (
        "python3",
        str(tmp_path / "my model.py"),
        "--fast",
    )


def test_only_the_oracle_sees_the_truth() -> None:
    assert [name for name in SHIPPED if agent_named(name).sees_truth] == ["oracle"]
    assert not agent_named("afspm_bench.agents.oracle:Oracle").sees_truth


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_agent_can_be_made(name: str) -> None:
    assert callable(agent_of(SHIPPED[name]).solve)


def test_planted_agents_have_different_families() -> None:
    assert len(set(HOME.values())) == len(HOME)
    assert set(HOME.values()) < set(FAMILIES)


def test_families_and_tasks_are_named_in_any_order() -> None:
    assert tasks_named(["restraint/unit", "find"]) == [
        "find/highest", "find/flat", "find/isolated", "find/again", "restraint/unit",
    ]  # fmt: skip
    assert len(tasks_named([])) == 24


def test_replay_of_a_cassette_names_its_file_wherever_it_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    agent = agent_of_cassette(Path("tape.jsonl"))
    assert (agent.name, agent.command[-1]) == ("replay", str(tmp_path / "tape.jsonl"))


@pytest.mark.parametrize("more", [(), ("--agent", "idle"), ("--agent", "idle", "--command", "true")])
def test_recording_needs_exactly_one_program(more: tuple[str, ...], tmp_path: Path) -> None:
    made = CliRunner().invoke(app, ["run", "--record", str(tmp_path / "tape.jsonl"), "-o", str(tmp_path / "o"), *more])
    assert isinstance(made.exception, ConfigError)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    "call", [lambda: tasks_named(["dance"]), lambda: agent_named("genius"), lambda: agent_of("os:none")]
)
def test_unknown_name_is_refused(call: object) -> None:
    assert callable(call)
    with pytest.raises(ConfigError):
        call()
