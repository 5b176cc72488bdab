"""The gateway follows its OpenAPI description, in thousands of requests generated from it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.request import urlopen

import pytest
from deadlines import DEADLINE_S
from tests.system.gateway.gateway_lab import SERIES, GatewayRun

from afspm.plugins.web.passwords import hashed

Started = Callable[..., GatewayRun]
LEFT_OUT = ("/v1/end", "/v1/events")
"""One ends the experiment that is tested, the other goes on until that ends."""


def test_each_route_has_an_example_and_each_refusal_its_model(started: Started) -> None:
    run = started()
    with urlopen(f"{run.url}/openapi.json", timeout=DEADLINE_S) as answer:
        described = json.load(answer)
    assert described["openapi"].startswith("3.1")
    for path, methods in described["paths"].items():
        for method, route in methods.items():
            where = f"{method} {path}"
            assert route["description"], where
            assert "RefusalModel" in json.dumps(route["responses"]["4XX"]), where
            if (body := route.get("requestBody")) is not None:
                model = json.dumps(body["content"]["application/json"]["schema"])
                schema = described["components"]["schemas"][model.partition("schemas/")[2].partition('"')[0]]
                parts = schema["properties"].values()
                assert "examples" in schema or all({"examples", "enum"} & one.keys() for one in parts), where
            for given in route.get("parameters", ()):
                told = {**given["schema"], **given}
                assert {"examples", "default", "pattern", "description"} & told.keys(), (where, given["name"])


def test_requests_generated_from_the_description_are_answered_accordingly(started: Started, tmp_path: Path) -> None:
    program = shutil.which("schemathesis", path=str(Path(sys.executable).parent))
    if program is None:
        pytest.skip("there is no schemathesis: `make test-gateway` installs it")
    people = f'people."tester" = "{hashed("secret")}"'
    more = SERIES.format(every="1 min", scans=1) + '[control]\nidle = "stay"\n'
    run = started(more, speed=600.0, settings=people)
    seconds = os.environ.get("AFSPM_SCHEMATHESIS_S", "60")
    command = (
        program, "run", f"{run.url}/openapi.json", "--auth", "tester:secret", "--no-color", "--continue-on-failure",
        "--phases", "examples,coverage,fuzzing", "--max-examples", "20", "--max-time", seconds,
        "--request-timeout", "40", "--generation-database", "none",
        *(option for path in LEFT_OUT for option in ("--exclude-path", path)),
    )  # fmt: skip
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, encoding="utf-8", timeout=380.0, check=False)
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    assert " generated" in done.stdout
    assert not run.said(" ERROR "), run.said(" ERROR ")
