"""`CorralEnvironment`: a server that offers a trial to an external agent, at the paths of corral's environments.

`GET /tasks`, `GET /tasks/ID/prompt`, `GET /tasks/ID/tools`, `POST /tasks/ID/tools/execute` {"tool_name", "arguments"},
`POST /tasks/ID/submit` {"answer": the report}, `POST /tasks/ID/surrender`. The score is always 0, since the bench
judges after the end. The address is printed as one line, and written to `corral.json` in the agent's folder.
"""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, HTTPServer

from afspm.basics import AfspmError
from afspm.model import Region
from afspm_bench.session import TrialSession


class CorralEnvironment:
    """Server of one trial until a report or a surrender, on AFSPM_BENCH_PORT or any free port of this computer."""

    def solve(self, session: TrialSession) -> None:
        scope = session.scope

        def scan(x_m: float, y_m: float, size_m: float, pixels: int) -> dict[str, object]:
            taken = scope.scan(Region((x_m, y_m), (size_m, size_m)), shape=(pixels, pixels))
            return {"time_ns": str(taken.time_ns), "height_m": taken["height"].values.tolist()}

        def spectrum(x_m: float, y_m: float, kind: str = "IV") -> dict[str, object]:
            taken = scope.spectrum((x_m, y_m), kind=kind)
            return {"time_ns": str(taken.time_ns), "names": taken.names, "values": taken.values.tolist()}

        tools: dict[str, Callable[..., object]] = {
            "scan": scan, "spectrum": spectrum, "get": scope.get, "set": scope.set, "action": scope.action,
            "sleep": scope.sleep, "minutes": lambda: session.elapsed_minutes,
        }  # fmt: skip
        id_ = session.task.replace("/", "-")
        prompt = "\n\n".join([session.prompt, *(f"{name}:\n{text}" for name, text in session.documents.items())])
        listed = [{"name": name, "description": "", "arguments": _arguments(tool)} for name, tool in tools.items()]
        pages = {
            "/tasks": [id_], "/dependency_chain": {"dependency_chain": False},
            f"/tasks/{id_}/prompt": {"prompt": prompt}, f"/tasks/{id_}/tools": {"tools": listed},
        }  # fmt: skip
        submitted: list[bool] = []

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.answer(pages.get(self.path.partition("?")[0]))

            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"] or 0)) or b"{}")
                match self.path.removeprefix(f"/tasks/{id_}/"):
                    case "configure":
                        self.answer({"status": "ready", "task_id": id_, "trial_id": "0"})
                    case "tools/execute" if body.get("tool_name") in tools:
                        self.answer({"result": tools[body["tool_name"]](**body.get("arguments", {}))})
                    case "submit" | "surrender" as how:
                        report = {"status": "cannot"} if how == "surrender" else body["answer"]
                        session.report(**(json.loads(report) if isinstance(report, str) else report))
                        submitted.append(True)
                        state = {"is_attempted": True, "submitted_answer": report}
                        self.answer({"score": 0.0, "state": state, "trial_id": "0", "surrendered": how == "surrender"})
                    case _:
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
                except (AfspmError, TypeError, ValueError, KeyError) as error:  # a refusal, or arguments that don't fit
                    self.answer({"detail": f"{getattr(error, 'code', 'invalid')}: {error}"}, 400)

        with HTTPServer(("127.0.0.1", int(os.environ.get("AFSPM_BENCH_PORT", "0"))), Handler) as server:
            url = f"http://127.0.0.1:{server.server_port}"
            (session.folder / "corral.json").write_text(json.dumps({"url": url}), encoding="utf-8")
            print(url, flush=True)  # noqa: T201 - the address, for a person
            while not submitted:
                server.handle_request()


def _arguments(tool: Callable[..., object]) -> list[dict[str, object]]:
    # each argument with its type in words; there are no choices
    found = inspect.signature(tool).parameters.values()
    plain = [one for one in found if one.kind is one.POSITIONAL_OR_KEYWORD]
    return [
        {"name": one.name, "type": str(one.annotation), "required": one.default is one.empty}
        | ({} if one.default is one.empty else {"default": one.default})
        for one in plain
    ]
