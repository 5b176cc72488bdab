"""`CorralEnvironment`: offers a trial to an agent outside as tools over HTTP, in the manner of corral's environments.

`GET /tasks` (the task and its prompt), `GET /tools`, `POST /execute` {"tool", "arguments"}, `POST /submit` (report).
The address is one line on the agent's output and in the file `corral.json` of its folder.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from afspm.basics.errors import AfspmError
from afspm.model import Region
from afspm.plugins.bench.session import TrialSession


class CorralEnvironment:
    """Serves one trial until the report is submitted, on AFSPM_BENCH_PORT or any free port of this computer."""

    def solve(self, session: TrialSession) -> None:
        scope = session.scope

        def scan(x_m: float, y_m: float, size_m: float, pixels: int) -> dict[str, Any]:
            taken = scope.scan(Region((x_m, y_m), (size_m, size_m)), shape=(pixels, pixels))
            return {"time_ns": str(taken.time_ns), "height_m": taken["Height"].values.tolist()}

        def spectrum(x_m: float, y_m: float, kind: str = "IV") -> dict[str, Any]:
            taken = scope.spectrum((x_m, y_m), kind=kind)
            return {"time_ns": str(taken.time_ns), "names": taken.names, "values": taken.values.tolist()}

        tools: dict[str, Callable[..., Any]] = {
            "scan": scan, "spectrum": spectrum, "get": scope.get, "set": scope.set, "action": scope.action,
            "sleep": scope.sleep, "minutes": lambda: session.elapsed_minutes,
        }  # fmt: skip
        facts = {"id": session.task, "prompt": session.prompt, "documents": dict(session.documents)}
        submitted: list[bool] = []

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.answer({"/tasks": [facts], "/tools": sorted(tools)}.get(self.path))

            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                if self.path == "/submit":
                    session.report(**body)
                    submitted.append(True)
                    self.answer({"submitted": True})
                elif self.path == "/execute" and body.get("tool") in tools:
                    self.answer({"result": tools[body["tool"]](**body.get("arguments", {}))})
                else:
                    self.answer(None)

            def answer(self, content: object, code: int = 200) -> None:
                sent = json.dumps(content).encode()
                self.send_response(404 if content is None else code)
                self.send_header("Content-Length", str(len(sent)))
                self.end_headers()
                self.wfile.write(sent)

            def handle_one_request(self) -> None:
                try:
                    super().handle_one_request()
                except (
                    AfspmError,
                    TypeError,
                    ValueError,
                    KeyError,
                ) as error:  # a refusal, or arguments that do not fit
                    self.answer({"error": f"{getattr(error, 'code', 'invalid')}: {error}"}, 400)

        with HTTPServer(("127.0.0.1", int(os.environ.get("AFSPM_BENCH_PORT", "0"))), Handler) as server:
            url = f"http://127.0.0.1:{server.server_port}"
            (session.folder / "corral.json").write_text(json.dumps({"url": url}), encoding="utf-8")
            print(url, flush=True)  # noqa: T201 - the address, for a person
            while not submitted:
                server.handle_request()
