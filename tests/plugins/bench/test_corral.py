"""A trial as tools over HTTP."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from deadlines import DEADLINE_S

from afspm import Scope
from afspm.basics import ExperimentClock, InvalidValue
from afspm.model import Region, Scan, ScanSet
from afspm.supervisor import FreePorts
from afspm_bench.corral import CorralEnvironment
from afspm_bench.session import TrialSession


class MadeScope:
    """A scope whose only skill is a scan."""

    def scan(self, region: Region, shape: tuple[int, int]) -> ScanSet:
        return ScanSet([Scan(region, "Height", "m", np.ones(shape), 17, roles=("height",))])

    def set(self, parameter: str, value: object) -> None:
        raise InvalidValue(f"{parameter} can't be {value}")

    get = spectrum = action = sleep = set


def test_trial_is_offered_and_ends_with_the_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = FreePorts().take()
    monkeypatch.setenv("AFSPM_BENCH_PORT", str(port))
    scope, clock = cast("Scope", MadeScope()), ExperimentClock.real()
    session = TrialSession("operate/made", scope, "Scan.", {}, {"a.txt": "b"}, clock, 0, 1.0, 1, tmp_path)
    # a daemon: a failing assertion leaves it without a report, and pytest would wait for it
    serving = threading.Thread(target=CorralEnvironment().solve, args=(session,), daemon=True)
    serving.start()

    def ask(path: str, content: object = None) -> tuple[int, Any]:
        data = None if content is None else json.dumps(content).encode()
        for _ in range(200):
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", data, timeout=DEADLINE_S) as answer:
                    return answer.status, json.load(answer)
            except urllib.error.HTTPError as error:
                return error.code, json.load(error)
            except urllib.error.URLError:  # it does not listen yet
                serving.join(0.05)
        raise AssertionError("the environment never listened")

    assert ask("/tasks") == (200, ["operate-made"])
    here = "/tasks/operate-made"
    assert ask(f"{here}/prompt")[1] == {"prompt": "Scan.\n\na.txt:\nb"}
    listed = {one["name"]: one["arguments"] for one in ask(f"{here}/tools?verbosity=full")[1]["tools"]}
    assert [one["name"] for one in listed["scan"]] == ["x_m", "y_m", "size_m", "pixels"]
    arguments = {"x_m": 0, "y_m": 0, "size_m": 1e-6, "pixels": 2}
    scanned = ask(f"{here}/tools/execute", {"tool_name": "scan", "arguments": arguments})
    assert scanned[1]["result"]["time_ns"] == "17"
    refused = {"parameter": "scan-speed", "value": 0}
    answer = ask(f"{here}/tools/execute", {"tool_name": "set", "arguments": refused})
    assert answer == (400, {"detail": "invalid-value: scan-speed can't be 0"})
    assert ask(f"{here}/tools/execute", {"tool_name": "rm"})[0] == 404
    assert ask("/tasks/another/submit", {"answer": {"status": "done"}})[0] == 404
    assert ask(f"{here}/submit", {"answer": {"status": "perhaps"}})[0] == 400
    status, ended = ask(f"{here}/submit", {"answer": json.dumps({"status": "done", "cites": ["17"]})})
    assert (status, ended["surrendered"]) == (200, False)
    serving.join(DEADLINE_S)
    assert not serving.is_alive()
    assert json.loads((tmp_path / "report.json").read_text())["cites"] == ["17"]
