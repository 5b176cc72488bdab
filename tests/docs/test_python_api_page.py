"""The reference of the Python API has everything that users write with, and says something of each."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

import afspm
from afspm.record.run import Run

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "python-api.md").read_text(encoding="utf-8")
LIBRARY_CALLS = {"run_process", "give_back_inherited"}


@pytest.mark.parametrize("name", afspm.__all__)
def test_every_public_name_has_an_entry(name: str) -> None:
    assert f"\n### {name}\n\n`afspm.{name}`\n" in PAGE


@pytest.mark.parametrize("class_", [afspm.Scope, afspm.Component, afspm.Region, afspm.Scan, afspm.Spectrum, Run])
def test_every_method_has_an_entry(class_: type) -> None:
    members = {name for name, _ in inspect.getmembers(class_, inspect.isfunction) if not name.startswith("_")}
    assert members
    assert {name for name in members - LIBRARY_CALLS if f"\n#### {class_.__name__}.{name}\n" not in PAGE} == set()


def test_no_entry_is_empty() -> None:
    assert not re.findall(r"^####? (.+)\n\n```py\n[^`]*```\n\s*(?=#)", PAGE, re.MULTILINE)
