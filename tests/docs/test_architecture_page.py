"""The page of the architecture shows the layers that `make check` keeps."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_layers_are_those_of_the_contract() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (layers,) = [contract["layers"] for contract in contracts if contract["type"] == "layers"]
    page = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")
    shown = re.search(r"```text\n(plugins\n.*?)\n```", page, re.DOTALL)
    assert shown is not None
    assert shown[1].splitlines() == layers
