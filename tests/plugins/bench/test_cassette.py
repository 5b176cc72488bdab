"""Cassettes: what counts as the same call, and as the same answer."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

from afspm.basics import FileError
from afspm.supervisor import FreePorts
from afspm_bench.cassette import (
    IdTranslation,
    ToolCall,
    differences,
    read_calls,
    recording,
    without_polls,
    write_calls,
)


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


class MadeServer(BaseHTTPRequestHandler):
    """Answers a call with the name of its tool: as JSON, or as a stream of events for the tool "stream"."""

    def do_POST(self) -> None:
        asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        tool = asked.get("params", {}).get("name", "")
        content = [{"type": "text", "text": json.dumps({"did": tool, "by": self.headers["Authorization"]})}]
        answer = json.dumps({"id": asked["id"], "result": {"content": content, "isError": tool == "no"}})
        body = f"event: message\ndata: {answer}\n\n" if tool == "stream" else answer
        self.send_response(200)
        self.send_header("Mcp-Session-Id", "s1")
        self.end_headers()
        self.wfile.write(body.encode())


@pytest.fixture
def server() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), MadeServer) as made:
        thread = threading.Thread(target=made.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{made.server_port}/mcp"
        made.shutdown()
        thread.join()


def post(url: str, content: object) -> Any:
    request = urllib.request.Request(url, json.dumps(content).encode(), {"Authorization": "Bearer agent:"})
    with urllib.request.urlopen(request, timeout=DEADLINE_S) as answer:
        return answer.read(), answer.headers["Mcp-Session-Id"]


def test_proxy_forwards_all_and_notes_calls_of_tools(server: str) -> None:
    calls: list[ToolCall] = []
    with recording(server, "Scan.", calls) as url:
        assert b"did" in post(url, {"id": 1, "method": "initialize"})[0]
        assert calls == []
        for number, tool in enumerate(("status", "stream", "no"), 2):
            params = {"name": tool, "arguments": {"n": number}}
            body, session = post(url, {"id": number, "method": "tools/call", "params": params})
            assert tool.encode() in body
            assert session == "s1"
    assert [(one.tool, one.arguments, one.is_error) for one in calls] == [
        ("status", {"n": 2}, False),
        ("stream", {"n": 3}, False),
        ("no", {"n": 4}, True),
    ]
    assert calls[1].answer == {"did": "stream", "by": "Bearer agent:"}


def test_proxy_answers_for_a_server_that_does_not() -> None:
    calls: list[ToolCall] = []
    with (
        recording(f"http://127.0.0.1:{FreePorts().take()}/mcp", "Scan.", calls) as url,
        pytest.raises(urllib.error.HTTPError, match="502"),
    ):
        post(url, {"id": 1, "method": "tools/call", "params": {"name": "status"}})
    assert calls == []
