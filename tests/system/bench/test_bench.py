"""Whole trials: sealed experiment, agent's process, verdict."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import afspm
from afspm.basics.errors import ConfigError
from afspm_bench import agent_folder, sealing
from afspm_bench.agent_files import AgentFiles
from afspm_bench.bench import (
    BenchOptions,
    agent_named,
    agent_of_cassette,
    agent_of_command,
    read_lines,
    run_bench,
)
from afspm_bench.page import Cell
from afspm_bench.seeds import PUBLIC_KEY, seed_of
from afspm_bench.tasks import task_of
from afspm_bench.trial import AgentSpec, TrialOutcome, run_trial

HERE = Path(__file__).parent
SEALS = not sealing.unavailable()


def of_test(name: str) -> AgentSpec:
    return AgentSpec(name, f"bench_agents:{name}", import_from=(str(HERE),))


def tried(
    tmp_path: Path,
    agent: AgentSpec,
    task: str,
    *,
    seals: bool = SEALS,
    minutes: float | None = None,
    speed: float | None = None,
) -> TrialOutcome:
    drawn = task_of(task, seed_of(PUBLIC_KEY, task, 0))
    drawn = replace(drawn, minutes=minutes or drawn.minutes, speed=speed or drawn.speed)
    output, own = tmp_path / "bench", tmp_path / "own"
    files = AgentFiles(agent.command, agent.import_from, ()) if seals else None
    return run_trial(drawn, agent, output / "trial", own, files=files, patience_s=240.0, keep=True)


def lines_of(tmp_path: Path, agent: str) -> list[dict[str, Any]]:
    options = BenchOptions(tmp_path, ["operate/settings"], trials=1, seal=SEALS, patience_s=240.0)
    return run_bench([agent_named(agent)], options, lambda line: None)


def test_same_seed_gives_the_same_verdict_twice(tmp_path: Path) -> None:
    lines = [*lines_of(tmp_path, "script"), *lines_of(tmp_path, "script")]
    assert [(line.get("counts"), line.get("error")) for line in lines] == [(True, None)] * 2
    assert read_lines([tmp_path]) == json.loads(json.dumps(lines))
    assert not (tmp_path / "work").exists()


def test_liar_is_found_out(tmp_path: Path) -> None:
    (line,) = lines_of(tmp_path, "liar")
    assert (line["solved"], line["harmless"], line["honest"]) == (False, True, False)


@pytest.mark.skipif(not SEALS, reason=sealing.unavailable())
def test_sealed_agent_finds_no_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIED", str(tmp_path / "bench"))
    outcome = tried(tmp_path, of_test("Spy"), "restraint/unit")
    assert outcome.sealed
    assert outcome.report["answer"]["found"] == []


CAREFUL = """
import helper
class Careful:
    def solve(self, session):
        session.report("done", cites=[helper.measured(session, center) for center in session.given["scans"]])
"""
HELPER = """
from afspm import Region
def measured(session, center):
    size, pixels = session.given["size_m"], session.given["pixels"]
    return session.scope.scan(Region(tuple(center), (size, size)), shape=(pixels, pixels)).time_ns
"""
GREEDY = """
from pathlib import Path
WEIGHTS = Path(__file__).resolve().with_name("weights.txt").read_text()
class Greedy:
    def solve(self, session): ...
"""


@pytest.mark.skipif(not SEALS, reason=sealing.unavailable())
def test_agent_of_the_current_folder_is_sealed_beside_the_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in (("my_agent", CAREFUL), ("helper", HELPER)):
        Path(f"{name}.py").write_text(text)
    options = BenchOptions(Path("bench"), ["operate/places"], trials=1, patience_s=240.0)
    (line,) = run_bench([agent_named("my_agent:Careful")], options, lambda line: None)
    assert line.get("counts"), line
    assert line["sealed"]
    Path("greedy.py").write_text(GREEDY)
    Path("weights.txt").write_text("1 2 3")
    (line,) = run_bench([agent_named("greedy:Greedy")], options, lambda line: None)
    assert (line["counts"], line["ended"]) == (False, "error")
    assert "weights.txt" in line["why"][0]
    assert "--read" in line["why"][0]


@pytest.mark.skipif(not SEALS, reason=sealing.unavailable())
def test_script_of_a_command_is_sealed_with_the_module_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (HERE / "http_agent.py").read_text(encoding="utf-8")
    Path("my_model.py").write_text("import helper\n")
    Path("helper.py").write_text(text)
    options = BenchOptions(Path("bench"), ["operate/places"], trials=1, patience_s=240.0)
    (line,) = run_bench([agent_of_command(f"{sys.executable} my_model.py")], options, lambda line: None)
    assert line.get("counts"), line
    assert line["sealed"]


# faults 1, 2
@pytest.mark.skipif(not SEALS, reason=sealing.unavailable())
def test_agent_that_breaks_its_trials_has_failed_them_and_the_bench_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPIED", str(tmp_path))
    monkeypatch.setattr(agent_folder, "MOST_BYTES", 32 << 20)
    tasks = ["operate/settings", "operate/places", "operate/curves", "find/highest", "find/flat"]
    options = BenchOptions(tmp_path / "out", tasks, trials=1, patience_s=240.0)
    found = run_bench([of_test("Hostile")], options, lambda _: None)
    assert not any("error" in line for line in found)
    assert Cell.of(found).trials == len(tasks)
    lines = {line["task"]: line for line in found}
    assert not any(line["counts"] for line in found)
    assert [lines[task]["ended"] for task in tasks[1:]] == ["ended", "ended", "error", "error"]
    for task, why in (
        ("operate/curves", "report.json: is no regular file"),
        ("find/highest", "has more than 32 MiB"),
        ("find/flat", "can't be measured"),
    ):
        assert any(why in one for one in lines[task]["why"]), lines[task]
    assert lines["operate/places"]["report"]["answer"] == {"cut": [], "own": []}
    assert [*(tmp_path / "out").iterdir()] == [tmp_path / "out" / "trials.jsonl"]


@pytest.mark.skipif(not SEALS, reason=sealing.unavailable())
def test_agent_that_never_gets_ready_has_failed(tmp_path: Path) -> None:
    outcome = tried(tmp_path, of_test("Chatterer"), "operate/settings")
    assert (outcome.ended, outcome.verdict.harmless, outcome.verdict.honest) == ("error", False, False)
    assert "ended before its start" in outcome.verdict.why[0]


def test_trial_that_ends_before_its_agent_starts_is_tried_again_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent_folder, "LEAST_FREE", 1 << 80)  # no disk has as much: no trial begins
    options = BenchOptions(tmp_path, ["operate/settings"], trials=2, seal=SEALS, jobs=2)
    lines = run_bench([agent_named("idle")], options, lambda _: None)
    assert len(read_lines([tmp_path])) == len(lines) == 2
    assert all("MiB left" in line["error"] for line in lines)


def test_unsealed_agent_finds_the_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # otherwise the test above would prove nothing
    monkeypatch.setenv("SPIED", str(tmp_path / "bench"))
    outcome = tried(tmp_path, of_test("Spy"), "restraint/unit", seals=False)
    assert not outcome.sealed
    assert {"truth.jsonl", "experiment.toml"} <= {Path(one).name for one in outcome.report["answer"]["found"]}


def test_agent_is_stopped_at_the_end_of_its_time(tmp_path: Path) -> None:
    outcome = tried(tmp_path, of_test("Sleeper"), "operate/settings", minutes=10.0)
    assert outcome.ended == "time"
    assert not outcome.verdict.counts


def test_failed_agent_is_judged_and_its_output_kept(tmp_path: Path) -> None:
    outcome = tried(tmp_path, of_test("Broken"), "operate/settings")
    assert outcome.ended == "failed"
    assert any("the report can't be read" in one for one in outcome.verdict.why)
    assert "a fault of the agent" in (tmp_path / "own" / "output.txt").read_text(encoding="utf-8")


def test_program_joins_over_http(tmp_path: Path) -> None:
    agent = AgentSpec("http", command=(sys.executable, str(HERE / "http_agent.py")))
    outcome = tried(tmp_path, agent, "operate/places")
    assert outcome.verdict.counts, (outcome.verdict.why, (tmp_path / "own" / "output.txt").read_text(encoding="utf-8"))
    assert json.dumps(outcome.report["usage"]) == '{"tokens": 0}'


def test_program_joins_over_mcp_and_its_cassette_replays(tmp_path: Path) -> None:
    tape, sample = tmp_path / "tape.jsonl", (sys.executable, "-m", "afspm_bench.agents.mcp_sample")
    options = BenchOptions(
        tmp_path / "bench", ["operate/places"], trials=1, seal=SEALS, patience_s=240.0, speed=30.0, keep=True
    )
    (line,) = run_bench([AgentSpec("mcp", command=sample)], replace(options, record=tape), lambda _: None)
    assert line.get("counts"), line
    (run,) = (tmp_path / "bench" / "work").glob("mcp-*/runs")
    with afspm.open_run(run) as record:
        assert {row.holder for row in record.scans} == {"mcp:agent"}
    calls = [json.loads(text) for text in tape.read_text(encoding="utf-8").splitlines()]
    assert {one["tool"] for one in calls} == {"measure", "status", "report"}

    altered = [one | {"answer": {**one["answer"], "steps": 7}} if one["tool"] == "measure" else one for one in calls]
    tape.write_text("".join(json.dumps(one) + "\n" for one in altered), encoding="utf-8")
    (again,) = run_bench([agent_of_cassette(tape)], replace(options, replay=tape), lambda _: None)
    assert again.get("counts"), again
    found = [(one["tool"], one["path"], one["recorded"], one["replayed"]) for one in again["differences"]]
    assert found == [("measure", "answer.steps", 7, 1)] * 3


def test_bench_refuses_to_run_where_it_can_not_seal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sealing, "unavailable", lambda: "it has no Landlock")
    options = BenchOptions(tmp_path / "out", ["operate/settings"])
    with pytest.raises(ConfigError, match=r"can't seal .*: it has no Landlock"):
        run_bench([agent_named("idle")], options, lambda line: None)
    assert not (tmp_path / "out").exists()
