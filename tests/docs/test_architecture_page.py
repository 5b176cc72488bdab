"""The page of the architecture names what is there, and shows the layers that `make check` keeps."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "afspm"
PAGE = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")


def _folders(parent: Path) -> set[str]:
    return {folder.name for folder in parent.iterdir() if any(folder.glob("*.py"))}


def test_layers_match_the_contract() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (layers,) = [contract["layers"] for contract in contracts if contract.get("containers") == ["afspm"]]
    shown = re.search(r"```text\n(plugins\n.*?)\n```", PAGE, re.DOTALL)
    assert shown is not None
    assert shown[1].splitlines() == layers


def test_every_room_and_every_guest_is_named() -> None:
    named = set(re.findall(r"`(\w+)/`", PAGE))
    assert _folders(PACKAGE) | _folders(PACKAGE / "plugins") <= named


def test_named_modules_exist() -> None:
    modules = re.findall(r"`((?:\w+/)+\w+\.py)`", PAGE)
    assert len(modules) > 15
    assert [module for module in modules if not (PACKAGE / module).exists()] == []


def test_every_room_begins_with_its_theory() -> None:
    short = [room for room in sorted(_folders(PACKAGE)) if len(_head(room)) < 200]
    assert set(short) <= {"cli", "testing", "components"}


def _head(room: str) -> str:
    return (PACKAGE / room / "__init__.py").read_text(encoding="utf-8").split('"""')[1]
