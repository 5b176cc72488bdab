"""The agent that gives the tools of the agent server to a language model, with a scripted model."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping, Sequence
from typing import Any

from afspm_bench.agents.language_model import MOST_TURNS, REPORT, converse


def completion(*calls: tuple[str, str]) -> dict[str, Any]:
    made = [{"id": str(n), "function": {"name": name, "arguments": given}} for n, (name, given) in enumerate(calls)]
    return {"choices": [{"message": {"role": "assistant", "tool_calls": made}}], "usage": {"completion_tokens": 3}}


class ScriptedModel:
    def __init__(self, *completions: dict[str, Any]) -> None:
        self.left = list(completions)
        self.asked: list[list[dict[str, Any]]] = []
        self.calls: list[tuple[str, Mapping[str, Any]]] = []

    async def ask(self, messages: Sequence[dict[str, Any]], tools: Sequence[dict[str, Any]]) -> dict[str, Any]:
        assert [one["function"]["name"] for one in tools] == ["measure", REPORT]
        self.asked.append(list(messages))
        return self.left.pop(0) if len(self.left) > 1 else self.left[0]

    async def call(self, name: str, given: Mapping[str, Any]) -> str:
        self.calls.append((name, given))
        return "measured"

    def run(self) -> dict[str, Any] | None:
        tools = [{"type": "function", "function": {"name": "measure"}}]
        return asyncio.run(converse("scan here", tools, self.ask, self.call))


def test_model_gets_the_answers_of_its_calls_and_its_report_counts_tokens() -> None:
    model = ScriptedModel(
        completion(("measure", '{"step": 1}')), completion((REPORT, json.dumps({"status": "done", "cites": [1]})))
    )
    assert model.run() == {
        "status": "done",
        "cites": [1],
        "usage": {"turns": 2, "prompt_tokens": 0, "completion_tokens": 6},
    }
    assert model.calls == [("measure", {"step": 1})]
    assert model.asked[1][-1] == {"role": "tool", "tool_call_id": "0", "content": "measured"}


def test_model_learns_that_its_arguments_are_no_json() -> None:
    model = ScriptedModel(completion(("measure", "{step")), completion((REPORT, '{"status": "cannot"}')))
    assert (model.run() or {})["status"] == "cannot"
    assert model.calls == []
    assert "no JSON" in model.asked[1][-1]["content"]


def test_report_that_the_bench_could_not_read_goes_back_to_the_model() -> None:
    unknown = completion((REPORT, '{"status": "cannot", "reason": "no tool"}'))
    model = ScriptedModel(unknown, completion((REPORT, '{"status": "cannot"}')))
    assert model.run() is not None
    assert model.asked[1][-1]["content"] == "a report has no field 'reason'"


def test_model_that_never_reports_makes_no_report() -> None:
    model = ScriptedModel({"choices": [{"message": {"role": "assistant", "content": "hello"}}]})
    assert model.run() is None
    assert len(model.asked) == MOST_TURNS
