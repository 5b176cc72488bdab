"""A whole experiment sends notifications of problems and of its end, and leaves its report."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from afspm_process import AFSPM
from deadlines import DEADLINE_S
from tests.system.experiment.experiment_lab import Run

SECRET = "T0PSECRET"
MORE = """
[control]
solved_by_hand = ["thermal-drift"]

[restart]
budget = 1

[breaks]
component = true
class = "trouble.Breaks"

[flags]
component = true
class = "trouble.Flags"

[notify]
command = ["python", "-c", "import sys; open('told.txt', 'a').write(sys.stdin.read() + chr(10))"]
webhook = "$NIGHT_HOOK"
unsolved_after = "1 min"
"""
TROUBLE = """
from afspm import Component


class Breaks(Component):
    def on_start(self):
        raise RuntimeError("broken")


class Flags(Component):
    flags = ("thermal-drift",)

    def on_scan(self, scan):
        self.scope.flag("thermal-drift")
"""


@pytest.fixture
def hook(monkeypatch: pytest.MonkeyPatch) -> Iterator[queue.Queue[dict[str, Any]]]:
    """Bodies of POST requests to the webhook."""
    posted: queue.Queue[dict[str, Any]] = queue.Queue()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            posted.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    monkeypatch.setenv("NIGHT_HOOK", f"http://127.0.0.1:{server.server_address[1]}/hooks/{SECRET}")
    yield posted
    server.shutdown()
    server.server_close()


def test_notification_arrives_and_leads_to_a_report(
    run: Run, tmp_path: Path, hook: queue.Queue[dict[str, Any]]
) -> None:
    (tmp_path / "trouble.py").write_text(TROUBLE, encoding="utf-8")
    one = run("--report", more=MORE)
    called = {(notice := hook.get(timeout=DEADLINE_S))["what"]: notice for _ in range(2)}
    assert called["given-up"]["text"].startswith("breaks is given up")
    assert "thermal-drift has been flagged for" in called["unsolved-problem"]["text"]
    ended = subprocess.run([*AFSPM, "end", "--yes", str(tmp_path / "runs")], timeout=DEADLINE_S, check=False)
    assert ended.returncode == 0
    last = hook.get(timeout=DEADLINE_S)
    assert (last["what"], last["run"], last["simulated"]) == ("end", str(one.folder), True)
    assert last["text"] == "the experiment has ended; given up: breaks"
    assert one.end() == 0, one.output
    assert hook.empty()

    told = [json.loads(line)["what"] for line in (tmp_path / "told.txt").read_text(encoding="utf-8").splitlines()]
    assert sorted(told) == ["end", "given-up", "unsolved-problem"]

    report = (one.folder / "report.html").read_text(encoding="utf-8")
    for said in ("SIMULATED", "thermal-drift flagged once", "given up: breaks", "not solved"):
        assert said in report
    kept = [file for file in one.folder.rglob("*") if file.is_file() and SECRET.encode() in file.read_bytes()]
    assert kept == []
    assert SECRET not in one.output
