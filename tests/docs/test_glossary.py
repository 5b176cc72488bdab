"""One name for one idea: the glossary names modules that exist, and class names are unique in the package."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "afspm"
GLOSSARY = ROOT / "docs" / "reference" / "glossary.md"
ROW = re.compile(r"^\| (?!term|---)([^|]+) \| ([^|]+) \| `([\w.]+)` \|$", re.MULTILINE)


def test_terms_are_at_least_fifty_and_unique() -> None:
    terms = [row[0] for row in ROW.findall(GLOSSARY.read_text(encoding="utf-8"))]
    assert len(terms) >= 50
    assert len(terms) == len(set(terms))


@pytest.mark.parametrize("module", sorted({row[2] for row in ROW.findall(GLOSSARY.read_text(encoding="utf-8"))}))
def test_module_of_a_term_exists(module: str) -> None:
    assert find_spec(module) is not None


def test_class_names_are_unique_in_the_package() -> None:
    places = defaultdict(list)
    for file in sorted(PACKAGE.rglob("*.py")):
        inside = file.relative_to(PACKAGE)
        in_vendor_folder = inside.parts[0] == "plugins" and len(inside.parts) > 2
        if in_vendor_folder or "generated" in inside.parts or "skeletons" in inside.parts:
            continue
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                places[node.name].append(str(inside))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}
