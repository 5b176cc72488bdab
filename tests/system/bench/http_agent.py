"""An agent without afspm: takes the ordered scans over HTTP, with nothing but the standard library."""

from __future__ import annotations

import json
import os
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

URL = os.environ["AFSPM_BENCH_URL"] + "/v1"


def ask(method: str, path: str, content: object = None) -> Any:
    request = urllib.request.Request(
        URL + path, None if content is None else json.dumps(content).encode(), method=method
    )
    request.add_header("Authorization", "Bearer agent:")
    request.add_header("Content-Type", "application/json")
    with urllib.request.urlopen(request, timeout=480) as answer:
        body = answer.read()
        return json.loads(body) if body else None


given = json.loads(Path("task.json").read_text(encoding="utf-8"))["given"]
ask("POST", "/control?wait_s=20", {"lease_s": 60})
cites = []
for number, center in enumerate(given["scans"]):
    region = {"center_m": center, "size_m": [given["size_m"]] * 2}
    ask("POST", "/scans", {"region": region, "shape": [given["pixels"]] * 2, "key": f"place-{number}"})
    while (state := ask("GET", f"/measurements/place-{number}?wait_s=20"))["state"] == "running":
        pass
    cites.append(state["result"])
ask("DELETE", "/control")
Path("report.json").write_text(json.dumps({"status": "done", "cites": cites, "usage": {"tokens": 0}}), encoding="utf-8")
