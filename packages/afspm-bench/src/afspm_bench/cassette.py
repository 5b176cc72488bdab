"""Cassettes: recordings of an agent's tool calls over MCP, for replay without the agent's model or its API key.

**Theory of operation.** A proxy between the agent's program and the agent server records each tool call with its
answer. A cassette is a file of JSON lines: one for each call, and one for the report at the end of a trial. The replay
is a program that joins in place of the agent: it repeats the calls of the trial with its prompt, in the same order.
Measurements get new ids, so the replay translates the ids. Consecutive equal calls are polls: they count as one call,
with the last answer. The recorded and new answers are then compared. Times and ids are ignored, and fractional numbers
may differ by 10 %.

Recorded texts of the model would depend on the provider's format and hold the whole conversation; replayed answers
without a microscope would test nothing but the cassette. A replay does not react: after an unequal answer, the next
call is the recorded one all the same. The proxy reads each answer as a whole, so it forwards no notifications.

    python -m afspm_bench.cassette FILE
"""

from __future__ import annotations

import json
import math
import os
import re
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Final

from afspm.basics import FileError, PlainMapping

REPORT_CALL: Final = "report"
"""Name that the line with the report has in place of a tool."""
_ID: Final = re.compile(r"\d{16,20}")  # ids of scans and spectra are times in ns
_TIME: Final = re.compile(r"\d{4}-\d\d-\d\dT[\d:.]+(Z|\+00:00)?")
_BENCH: Final = re.compile(r"bench-[0-9a-f]{8}")  # the bench draws its name at random in each trial
_COMPARED: Final = {"status": frozenset({"mode", "problems", "approvals", "runs", "ended"})}
"""Compared fields of tools whose other fields depend on the moment of the call."""
_WITHIN: Final = 0.1  # relative: two runs of a seed have different noise
_FORWARDED: Final = ("authorization", "content-type", "accept", "mcp-session-id", "mcp-protocol-version")
_TIMEOUT_S: Final = 300.0
_MOST_BYTES: Final = 1 << 20  # of one call of an agent; the bench keeps all calls of a trial


@dataclass(frozen=True)
class ToolCall:
    """One tool call, with its answer.

    Attributes:
        prompt: prompt of the trial, which identifies the trial.
        answer: first text of the answer, decoded from JSON (None if it is not JSON); pictures are not kept.
    """

    prompt: str
    tool: str
    arguments: PlainMapping = field(default_factory=dict)
    is_error: bool = False
    answer: object = None


@dataclass(frozen=True)
class AnswerDifference:
    """One difference between a recorded and a new answer: number of the call, from 1, and path within the answer."""

    call: int
    tool: str
    path: str
    recorded: object
    replayed: object


def write_calls(file: Path, calls: Sequence[ToolCall]) -> None:
    """Append calls to a cassette. Raises FileError."""
    try:
        with file.open("a", encoding="utf-8") as out:
            out.writelines(json.dumps(asdict(one)) + "\n" for one in calls)
    except OSError as error:
        raise FileError(f"can't be written: {error}", where=str(file)) from error


def read_calls(file: Path, prompt: str) -> list[ToolCall]:
    """Return the recorded calls of the trial with a prompt.

    Raises:
        FileError: the file can't be read, is no cassette, or does not contain the trial.
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
        found = [ToolCall(**json.loads(line)) for line in lines if line.strip()]
    except (OSError, ValueError, TypeError) as error:
        raise FileError(f"is no cassette: {error}", where=str(file)) from error
    if not (own := [one for one in found if one.prompt == prompt]):
        raise FileError("has no calls for this task and seed", where=str(file), hint="record this trial first")
    return own


def without_polls(calls: Sequence[ToolCall]) -> list[ToolCall]:
    """Return the calls with only the last of consecutive calls of one tool with equal arguments."""
    followed = zip(calls, [*calls[1:], None], strict=True)
    return [one for one, after in followed if after is None or _key(one) != _key(after)]


def _key(call: ToolCall) -> tuple[str, str]:
    return call.tool, json.dumps(call.arguments, sort_keys=True)


def differences(recorded: Sequence[ToolCall], replayed: Sequence[ToolCall]) -> list[AnswerDifference]:
    """Return the differences between recorded and new answers to the same calls; repeated polls count as one call.

    A recorded call without a new call is a difference, too, with an empty path.
    """
    old, new = without_polls(recorded), without_polls(replayed)
    found = []
    for number, (one, other) in enumerate(zip(old, new, strict=False), 1):
        found += [AnswerDifference(number, one.tool, *place) for place in _differing(_facts(one), _facts(other), "")]
    for number, one in enumerate(old[len(new) :], len(new) + 1):
        found.append(AnswerDifference(number, one.tool, "", one.answer, None))
    return found


def _facts(call: ToolCall) -> dict[str, object]:
    answer, compared = call.answer, _COMPARED.get(call.tool)
    if compared is not None and isinstance(answer, dict):
        answer = {name: one for name, one in answer.items() if name in compared}
    return {"error": call.is_error, "answer": answer}


def _differing(old: object, new: object, path: str) -> Iterator[tuple[str, object, object]]:
    if isinstance(old, dict) and isinstance(new, dict):
        for name in sorted(old.keys() | new.keys()):
            yield from _differing(old.get(name), new.get(name), f"{path}.{name}" if path else str(name))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (one, other) in enumerate(zip(old, new, strict=True)):
            yield from _differing(one, other, f"{path}[{index}]")
    elif not _is_same(old, new):
        yield path, old, new


def _is_same(old: object, new: object) -> bool:
    if isinstance(old, str) and isinstance(new, str):
        volatile = any(kind.fullmatch(old) and kind.fullmatch(new) for kind in (_ID, _TIME, _BENCH))
        return volatile or old == new
    if isinstance(old, float) and isinstance(new, float):
        return math.isclose(old, new, rel_tol=_WITHIN, abs_tol=1e-12)
    return bool(old == new) and isinstance(old, bool) is isinstance(new, bool)


class IdTranslation:
    """Translation of recorded measurement ids into new ids, learnt from pairs of answers."""

    def __init__(self) -> None:
        self._new: dict[str, str] = {}

    def learn(self, old: object, new: object) -> None:
        """Learn the ids at the same places of a recorded and a new answer."""
        if isinstance(old, dict) and isinstance(new, dict):
            for name in old.keys() & new.keys():
                self.learn(old[name], new[name])
        elif isinstance(old, list) and isinstance(new, list):
            for one, other in zip(old, new, strict=False):
                self.learn(one, other)
        elif isinstance(old, str) and isinstance(new, str) and _ID.fullmatch(old) and _ID.fullmatch(new):
            self._new.setdefault(old, new)

    def of(self, plain: object) -> object:
        """Return JSON data with all known ids translated."""
        if isinstance(plain, dict):
            return {name: self.of(one) for name, one in plain.items()}
        if isinstance(plain, list):
            return [self.of(one) for one in plain]
        return self._new.get(plain, plain) if isinstance(plain, str) else plain


@contextmanager
def recording(url: str, prompt: str, calls: list[ToolCall]) -> Iterator[str]:
    """Yield the address of a proxy of an agent server, which appends each tool call to `calls`."""
    lock = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            size = self.headers.get("Content-Length", "")
            if not size.isdecimal() or int(size) > _MOST_BYTES:
                self.close_connection = True
                self.reply(413, {}, b"")
                return
            body = self.rfile.read(int(size))
            status, headers, answer = _forwarded(url, "POST", self.headers, body)
            with lock:
                calls.extend(_calls_in(prompt, body, answer))
            self.reply(status, headers, answer)

        def do_DELETE(self) -> None:
            self.reply(*_forwarded(url, "DELETE", self.headers, None))

        def do_GET(self) -> None:
            self.reply(405, {}, b"")  # a server may decline the stream of its own messages, and tools need none

        def reply(self, status: int, headers: Mapping[str, str], body: bytes) -> None:
            self.send_response(status)
            for name in ("Content-Type", "Mcp-Session-Id"):
                if name.lower() in headers:
                    self.send_header(name, headers[name.lower()])
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Write nothing: the calls are the log."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, name="cassette", daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/mcp"
        finally:
            server.shutdown()
            thread.join()


def _forwarded(url: str, method: str, headers: Message, body: bytes | None) -> tuple[int, dict[str, str], bytes]:
    request = urllib.request.Request(url, body, method=method)
    for name in _FORWARDED:
        if headers.get(name):
            request.add_header(name, headers[name])
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            return answer.status, {name.lower(): value for name, value in answer.headers.items()}, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, {name.lower(): value for name, value in error.headers.items()}, error.read()
    except OSError as error:
        return 502, {"content-type": "text/plain"}, f"the agent server does not answer: {error}".encode()


def _calls_in(prompt: str, body: bytes, answer: bytes) -> Iterator[ToolCall]:
    asked = _json(body)
    if not isinstance(asked, dict) or asked.get("method") != "tools/call":
        return
    # an answer is JSON, or a stream of events with JSON as their data
    texts = [answer, *(line[5:] for line in answer.splitlines() if line.startswith(b"data:"))]
    for content in map(_json, texts):
        if isinstance(content, dict) and content.get("id") == asked.get("id"):
            result = content.get("result") or {}
            text = next((one["text"] for one in result.get("content", ()) if one.get("type") == "text"), "null")
            is_error = bool(result.get("isError")) or "error" in content
            given = asked["params"]
            yield ToolCall(prompt, given["name"], given.get("arguments") or {}, is_error, _json(text.encode()))


def _json(text: bytes) -> object:
    try:
        return json.loads(text)
    except ValueError:
        return None


async def replay(calls: Sequence[ToolCall], url: str, token: str, folder: Path) -> None:
    """Repeat recorded calls to an agent server, and write the recorded report into a folder."""
    import asyncio

    import httpx2
    from mcp import Client
    from mcp.client.streamable_http import streamable_http_client

    ids = IdTranslation()
    http = httpx2.AsyncClient(headers={"Authorization": f"Bearer {token}"}, timeout=_TIMEOUT_S)
    async with http, Client(streamable_http_client(url, http_client=http)) as client:
        for call in without_polls(calls):
            if call.tool == REPORT_CALL:
                (folder / "report.json").write_text(json.dumps(ids.of(call.answer)), encoding="utf-8")
                continue
            while True:
                arguments = {name: ids.of(one) for name, one in call.arguments.items()}
                answer = await client.call_tool(call.tool, arguments)
                text = next((one.text for one in answer.content if one.type == "text"), "null")
                found = _json(text.encode())
                if not _runs(found) or _runs(call.answer):
                    break
                await asyncio.sleep(0.2)  # the agent has polled until its run had ended
            ids.learn(call.answer, found)


def _runs(answer: object) -> bool:
    # whether a run goes on, in an answer of `status`
    runs = answer.get("runs", ()) if isinstance(answer, dict) else ()
    return any(isinstance(one, dict) and one.get("state") == "running" for one in runs)


def main(arguments: Sequence[str]) -> int:
    """Replay the trial whose prompt is in the current folder; return an exit code."""
    import asyncio

    prompt = Path("prompt.txt").read_text(encoding="utf-8")
    calls = read_calls(Path(arguments[0]), prompt)
    environment = os.environ
    url, token = environment["AFSPM_BENCH_MCP_URL"], environment["AFSPM_BENCH_MCP_TOKEN"]
    asyncio.run(replay(calls, url, token, Path.cwd()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
