"""The reference of the Python API has an entry with a text for every public name."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path
from types import ModuleType

import pytest

import afspm
from afspm.night.run import Run

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "python-api.md").read_text(encoding="utf-8")
ENTRY = re.compile(r"^- ((?:`[^`:]*`, )*`[^`:]*`): ", re.MULTILINE)
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


@pytest.fixture
def generator(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "tools"))
    return importlib.import_module("python_api")


def test_a_continuation_line_with_a_colon_stays_in_its_entry(generator: ModuleType) -> None:
    def documented() -> None:
        """Return the axes.

        Args:
            first, second: ends of the range, which is cut at
                the surface, to common values: evenly spaced.

        Returns:
            The axes. Their coordinates are in m, with ticks: text
            goes on.
        """

    assert generator._markdown(documented).splitlines() == [
        "Return the axes.",
        "",
        "**Args:**",
        "",
        "- `first`, `second`: ends of the range, which is cut at",
        "  the surface, to common values: evenly spaced.",
        "",
        "**Returns:**",
        "",
        "The axes. Their coordinates are in m, with ticks: text",
        "goes on.",
    ]


def test_every_documented_argument_is_a_name() -> None:
    names = [name for entry in ENTRY.findall(PAGE) for name in entry.replace("`", "").split(", ")]
    assert len(names) > 100
    assert [name for name in names if " " in name] == []
