"""The table of names that packages of this repository bring."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from afspm.basics.entry_points import CLASSES, COMMANDS
from afspm.basics.packages import BROUGHT_BY, advice

ROOT = Path(__file__).parents[3]


def project(folder: Path) -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return table


@pytest.mark.parametrize("package", sorted({*BROUGHT_BY.values()}))
def test_table_has_the_names_that_a_package_declares_for_this_version(package: str) -> None:
    found = project(ROOT / "packages" / package)
    declared = {name for group in (*CLASSES, COMMANDS) for name in found["entry-points"].get(group, {})}
    assert {name for name, of in BROUGHT_BY.items() if of == package} == declared
    assert f"afspm=={project(ROOT)['version']}" in found["dependencies"]


def test_other_names_get_no_advice() -> None:
    assert "pip install ./packages/afspm-published" in advice("PublishedPeers")
    assert advice("ScanSeries") == ""
