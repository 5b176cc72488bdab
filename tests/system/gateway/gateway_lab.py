"""An experiment with a gateway, and a client that uses only Python's standard library."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import IO, Any
from urllib.parse import urlsplit

from afspm_process import AfspmProcess
from deadlines import DEADLINE_S

EXPERIMENT = """
[clock]
speed = {speed}

[microscope]
component = true
class = "Simulator"
seed = 1
initial = {{ scan-speed = "2 um/s" }}

[scheduler]
component = true
class = "Scheduler"

[gateway]
component = true
class = "Gateway"
port = 0
{settings}

[limits]
region = {{ x = ["-5 um", "5 um"], y = ["-5 um", "5 um"] }}

[limits.tip-bias-voltage]
max = "3 V"
"""
SERIES = """
[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [32, 32]
every = "{every}"
scans = {scans}
"""
REGION = {"center_m": [0.0, 0.0], "size_m": [1e-6, 1e-6]}


@dataclass
class Answer:
    status: int
    body: Any
    headers: dict[str, str]

    @property
    def code(self) -> str:
        code: str = self.body["code"]
        return code


@dataclass
class Event:
    id: str
    kind: str
    data: Any


class Client:
    """Sends requests to a gateway, each in a connection of its own."""

    def __init__(self, url: str, name: str = "", token: str = "") -> None:
        self.address = urlsplit(url).netloc
        self.headers = {"Connection": "close"}
        if name:
            shown = base64.b64encode(f"{name}:{token}".encode()).decode()
            self.headers["Authorization"] = f"Basic {shown}"

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> Answer:
        connection = HTTPConnection(self.address, timeout=DEADLINE_S)
        try:
            sent = None if body is None else json.dumps(body)
            kind = {} if body is None else {"Content-Type": "application/json"}
            connection.request(method, f"/v1{path}", sent, {**self.headers, **kind, **headers})
            answer = connection.getresponse()
            read, told = answer.read(), dict(answer.headers)
            is_json = told.get("content-type", "").startswith("application/json")
            return Answer(answer.status, json.loads(read) if is_json and read else read, told)
        finally:
            connection.close()

    def get(self, path: str) -> Any:
        answer = self.ask("GET", path)
        assert answer.status == 200, answer
        return answer.body

    def done(self, method: str, path: str, body: Any = None) -> Any:
        answer = self.ask(method, path, body)
        assert answer.status in (200, 202), answer
        return answer.body

    def until_measured(self, key: str) -> Any:
        """Return the measurement at its end."""
        end_s = time.monotonic() + DEADLINE_S
        while (found := self.get(f"/measurements/{key}?wait_s=5"))["state"] == "running":
            assert time.monotonic() < end_s, found
        return found

    def events(self, path: str = "/events", last: str = "") -> Generator[Event]:
        """Yield the streamed events until the gateway closes or vanishes."""
        connection = HTTPConnection(self.address, timeout=DEADLINE_S)
        connection.request("GET", f"/v1{path}", headers={**self.headers, **({"Last-Event-ID": last} if last else {})})
        stream = connection.getresponse()
        assert stream.status == 200, stream.read()
        try:
            yield from self.read_events(stream)
        finally:
            connection.close()

    def read_events(self, stream: IO[bytes]) -> Iterator[Event]:
        """Return the events in a stream, up to the last complete one."""
        parts = dict[str, str]()
        try:
            while line := stream.readline().decode():
                name, _, value = line.rstrip("\r\n").partition(": ")
                if name:
                    parts[name] = value
                elif "event" in parts:
                    yield Event(parts["id"], parts["event"], json.loads(parts["data"]))
                    parts = {}
        except (OSError, ValueError):
            pass  # cut off


class GatewayRun(AfspmProcess):
    """`afspm run` of an experiment with a gateway."""

    def __init__(
        self, folder: Path, more: str = "", speed: float = 60.0, settings: str = "", file: Path | None = None
    ) -> None:
        if file is None:
            file = folder / "experiment.toml"
            file.write_text(EXPERIMENT.format(speed=speed, settings=settings) + more, encoding="utf-8")
        super().__init__("run", "--verbose", "--no-report", str(file), "--runs", str(folder / "runs"), folder=folder)
        self.url = self.wait_for_url("gateway")

    def client(self, name: str = "", token: str = "") -> Client:
        return Client(self.url, name, token)
