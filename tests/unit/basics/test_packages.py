"""The table of names that packages of this repository bring."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from afspm.basics.entry_points import CLASSES, COMMANDS, FUNCTIONS
from afspm.basics.packages import BROUGHT_BY, advice

ROOT = Path(__file__).parents[3]


def project(folder: Path) -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return table


@pytest.mark.parametrize("package", sorted({*BROUGHT_BY.values()}))
def test_table_has_the_names_that_a_package_declares_for_this_version(package: str) -> None:
    found = project(ROOT / "packages" / package)
    groups = found["entry-points"]
    declared = {name for group in (*CLASSES, COMMANDS, FUNCTIONS) for name in groups.get(group, {})}
    declared |= {f"drift {name}" for name in groups.get("afspm.drift_commands", {})}
    assert {name for name, of in BROUGHT_BY.items() if of == package} == declared
    needed = {re.sub(r"\[.*\]", "", one) for one in found["dependencies"]}
    assert f"afspm=={project(ROOT)['version']}" in needed


def test_other_names_get_no_advice() -> None:
    assert "pip install ./packages/afspm-published" in advice("PublishedPeers")
    assert advice("ScanSeries") == ""
