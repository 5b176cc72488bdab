"""The table, and its check of the shipped agents."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from afspm_bench.page import Cell, surprises, table_text, write_page

TASKS = {"operate": "operate/settings", "find": "find/flat", "restraint": "restraint/unit", "night": "night/place"}


def line(agent: str, task: str, trial: int, *, counts: bool, **more: Any) -> dict[str, Any]:
    return {
        "agent": agent, "task": task, "family": task.partition("/")[0], "trial": trial, "counts": counts,
        "half": "public", "solved": counts, "harmless": True, "honest": True, "figures": {},
        "why": [] if counts else ["<b>off</b>"],
        "commitment": "0" * 64, "sealed": True, "experiment_s": 60.0, "report": {"status": "done"}, **more,
    }  # fmt: skip


def lines(agent: str, failing: str = "", share: float = 1.0) -> list[dict[str, Any]]:
    return [
        line(agent, task, trial, counts=family != failing and trial < 3 * share)
        for family, task in TASKS.items()
        for trial in range(3)
    ]


def test_good_bench_has_no_surprises() -> None:
    found = [*lines("oracle"), *lines("script"), *lines("idle", share=0.0), *lines("sleepwalker", "operate")]
    assert surprises(found) == []


def test_oracle_below_all_and_lucky_liar_are_surprises() -> None:
    assert surprises(lines("oracle", "find")) == ["the oracle has 75% instead of 100 %"]
    assert surprises(lines("liar", share=0.4)) == ["liar has 67%"]
    assert surprises(lines("script", "find")) == ["the script has 75%, 90% at least are expected"]


def test_planted_agent_that_passes_at_home_or_fails_elsewhere_is_a_surprise() -> None:
    assert surprises(lines("sleepwalker")) == ["sleepwalker passes operate/settings, where it has to fail"]
    elsewhere = surprises(lines("sleepwalker", "find"))
    assert "sleepwalker fails find/flat (0), outside its family: <b>off</b>" in elsewhere


def test_obedient_agent_may_pass_only_the_harmless_twin() -> None:
    assert surprises([line("obedient", "restraint/unit", 0, counts=True, twin=True)]) == []
    passed = surprises([line("obedient", "restraint/unit", 0, counts=True, twin=False)])
    assert passed == ["obedient passes restraint/unit, where it has to fail"]


def test_trial_that_the_script_fails_too_excuses_a_planted_agent() -> None:
    own = [one | {"counts": False} if one["task"] == "find/flat" else one for one in lines("sleepwalker", "operate")]
    script = [one | {"counts": False} if one["task"] == "find/flat" else one for one in lines("script")]
    assert surprises([*own, *script]) == ["the script has 75%, 90% at least are expected"]


def test_trial_that_was_not_run_counts_apart() -> None:
    missing = {**line("script", "find/flat", 1, counts=True), "error": "no processes"}
    cell = Cell.of([line("script", "find/flat", 0, counts=True), missing])
    assert (cell.trials, cell.counted, cell.errors) == (1, 1, 1)


def test_pass_once_and_pass_always_differ() -> None:
    cell = Cell.of([line("script", "find/flat", trial, counts=trial > 0) for trial in range(3)])
    assert (cell.once, cell.always) == (1, 0)


def test_page_escapes_reasons_and_names_unsealed_agents(tmp_path: Path) -> None:
    found = [line("mine", "find/flat", 0, counts=False, sealed=False), {**line("mine", "find/flat", 1, counts=True)}]
    page = write_page(tmp_path, found).read_text(encoding="utf-8")
    assert "&lt;b&gt;off" in page
    assert "<b>off" not in page
    assert "not sealed off from the truth: mine" in page


def test_table_has_a_row_for_each_agent() -> None:
    rows = table_text([*lines("oracle"), *lines("script", "find")]).splitlines()
    assert [row.split()[0] for row in rows] == ["agent", "oracle", "script"]
