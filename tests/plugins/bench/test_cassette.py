"""Cassettes: what counts as the same call, and as the same answer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from afspm.basics.errors import FileError
from afspm.plugins.bench.cassette import IdTranslation, ToolCall, differences, read_calls, without_polls, write_calls


def call(tool: str, answer: Any, *, is_error: bool = False, **arguments: Any) -> ToolCall:
    return ToolCall("Scan.", tool, arguments, is_error, answer)


def test_polls_count_as_one_call_with_the_last_answer() -> None:
    calls = [call("status", 1), call("status", 2), call("measure", 3, step=1), call("measure", 4, step=2)]
    assert [one.answer for one in without_polls(calls)] == [2, 3, 4]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("1795565696094106400", "1795580103497892400"),
        ("2026-11-25T00:12:00Z", "2026-11-25T03:00:01.5Z"),
        (1.00e-9, 1.05e-9),
        (3, 3),
        ("done", "done"),
        ("bench-27af608f", "bench-aceb7b7d"),
    ],
)
def test_answer_with_other_ids_times_and_noise_is_the_same(old: object, new: object) -> None:
    assert differences([call("scans", {"x": [old]})], [call("scans", {"x": [new]})]) == []


@pytest.mark.parametrize(("old", "new"), [("done", "failed"), (1.0e-9, 1.3e-9), (3, 4), (True, 1), (3, None)])
def test_other_answer_is_named_with_its_place(old: object, new: object) -> None:
    (found,) = differences(
        [call("limits", 0), call("status", {"runs": [{"x": old}]})],
        [call("limits", 0), call("status", {"runs": [{"x": new}]})],
    )
    assert (found.call, found.tool, found.path) == (2, "status", "answer.runs[0].x")
    assert (found.recorded, found.replayed) == (old, new)


def test_moment_of_a_look_is_no_difference() -> None:
    assert (
        differences([call("status", {"free": True, "runs": []})], [call("status", {"free": False, "runs": []})]) == []
    )
    assert differences([call("scans", {"free": True})], [call("scans", {"free": False})]) != []


def test_refusal_and_missing_call_are_differences() -> None:
    old = [call("measure", {"run": "1"}), call("status", {})]
    found = differences(old, [call("measure", {"run": "1"}, is_error=True)])
    assert [(one.call, one.path) for one in found] == [(1, "error"), (2, "")]


def test_ids_are_translated_in_later_arguments() -> None:
    ids = IdTranslation()
    ids.learn({"results": ["1795565696094106400"], "n": 1}, {"results": ["1795580103497892400"], "n": 1})
    assert ids.of({"cites": ["1795565696094106400", "7"]}) == {"cites": ["1795580103497892400", "7"]}


def test_cassette_keeps_the_calls_of_each_trial(tmp_path: Path) -> None:
    file, calls = tmp_path / "tape.jsonl", [call("status", {"a": [1]}, x="y")]
    write_calls(file, calls)
    write_calls(file, [ToolCall("Another.", "stop")])
    assert read_calls(file, "Scan.") == calls
    with pytest.raises(FileError, match="no calls for this task and seed"):
        read_calls(file, "Unknown.")
    file.write_text("{}\n", encoding="utf-8")
    with pytest.raises(FileError, match="is no cassette"):
        read_calls(file, "Scan.")
