"""This package is made outside of afspm: it imports what afspm's doors list, and a few names that no door lists yet."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import afspm_nion

DOORS = {"afspm", "afspm.model", "afspm.translator"}
BEHIND = {
    "afspm.basics.errors": {"ConfigError", "Refused"},
    "afspm.basics.units": {"Speed"},
    "afspm.storage.atomic": {"write_atomic"},
    "afspm.translator.own_files": {"FileFacts", "encode_scan"},
    "afspm.translator.setting_groups": {"FRAME", "SettingsGroup", "frame", "frame_values"},
}
"""Names that a driver needs and no door lists yet. This list can only shrink."""
FILES = sorted(Path(afspm_nion.__file__).parent.glob("*.py"))


def imported(file: Path) -> Iterator[tuple[str, str]]:
    """Yield the modules of afspm that a file imports, with the imported name or an empty text."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            found = [(node.module, alias.name) for alias in node.names]
        else:
            found = [(alias.name, "") for alias in node.names] if isinstance(node, ast.Import) else []
        yield from (one for one in found if one[0].split(".")[0] == "afspm")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_package_imports_doors_alone(file: Path) -> None:
    past = {(module, name) for module, name in imported(file) if module not in DOORS}
    assert past <= {(module, name) for module, names in BEHIND.items() for name in names}


def test_names_behind_doors_are_needed() -> None:
    needed = {one for file in FILES for one in imported(file)}
    assert {(module, name) for module, names in BEHIND.items() for name in names} <= needed
