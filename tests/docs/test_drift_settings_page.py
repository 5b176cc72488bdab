"""The settings of estimators and trackers in the how-to exist, with the documented defaults."""

from __future__ import annotations

import dataclasses
import inspect
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from afspm.basics import entry_points
from afspm.plugins.drift.track.references import Choice
from afspm.plugins.drift.track.settings import BankSettings

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "drift.md"
ROW = re.compile(r"^\| ((?:`\w+`(?:, )?)+) \| `(\w+)` \| `([^`]+)` \|", re.MULTILINE)
ROWS = [
    (owner, setting, default)
    for owners, setting, default in ROW.findall(PAGE.read_text(encoding="utf-8"))
    for owner in re.findall(r"`(\w+)`", owners)
]


def defaults(owner: str) -> dict[str, Any]:
    if owner == "bank":
        return {field.name: field.default for one in (BankSettings, Choice) for field in dataclasses.fields(one)}
    group = entry_points.TRACKERS if owner == "paper" else entry_points.ESTIMATORS
    parameters = inspect.signature(entry_points.load(group, owner)).parameters
    return {name: one.default for name, one in parameters.items()}


def test_table_is_found() -> None:
    assert {owner for owner, _, _ in ROWS} == {"paper", "bank", "brief", "orb", "sift", "correlation"}


@pytest.mark.parametrize(("owner", "setting", "default"), ROWS)
def test_setting_has_the_documented_default(owner: str, setting: str, default: str) -> None:
    assert defaults(owner)[setting] == tomllib.loads(f"value = {default}")["value"]
