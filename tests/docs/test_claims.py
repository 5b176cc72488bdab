"""The marks of drivers name claims, and each claim has what the table needs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
CLAIM = """
[rows-ascend]
claim = "Rows of a file ascend in y."
grade = "none"
source = "by analogy"
settle = "Compare a file with the panel."
commission = "axes"
"""


@pytest.fixture(scope="module")
def tool() -> Iterator[ModuleType]:
    sys.path.insert(0, str(ROOT / "tools"))
    yield import_module("claims")
    sys.path.remove(str(ROOT / "tools"))


def test_marks_of_all_drivers_have_their_claims(tool: ModuleType) -> None:
    assert [fault for folder in tool.quality.drivers().values() for fault in tool.faults(folder)] == []


@pytest.mark.parametrize(
    ("code", "claims", "fault"),
    [
        ("row = 1  # (! rows-ascend)", CLAIM, ""),
        ("row = 1  # (! rows-ascend, angles)", CLAIM, "driver.py:1: (! angles) has no row"),
        ("\nrow = 1  # (!) ascending", CLAIM, "driver.py:2: (!) names no claim"),
        ("", CLAIM.replace("axes", "axis"), "rows-ascend: no step is called 'axis'"),
        ("", CLAIM.replace('"none"', '"sure"'), "rows-ascend: 'sure' is no grade"),
        ("", CLAIM.replace("settle", "settles"), "settles"),
        ("", "", "claims.toml: is missing"),
    ],
)
def test_mark_without_a_claim_is_a_fault(tool: ModuleType, code: str, claims: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / "driver.py").write_text(code, encoding="utf-8")
    if claims:
        (tmp_path / "claims.toml").write_text(claims, encoding="utf-8")
    found = list(tool.faults(tmp_path))
    assert len(found) == bool(fault)
    assert fault in "".join(found)


def test_table_shows_verdicts_of_instruments_and_none_of_emulators(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "claims.toml").write_text(CLAIM, encoding="utf-8")
    for tried_on, verdict in (("emulator", "holds"), ("instrument", "does not hold")):
        report = tool.InstrumentReport(
            "maker", "Mine", f"release of {tried_on}", tried_on, "", "", "", {}, claims={"rows-ascend": verdict}
        )
        (tmp_path / "reports").mkdir(exist_ok=True)
        report.write(tmp_path / "reports" / f"{tried_on}.toml")
    monkeypatch.setattr(tool.quality, "drivers", lambda: {"Mine": tmp_path})
    assert "`axes`, at the sample; **does not hold** (release of instrument)" in tool.table()
    assert "release of emulator" not in tool.table()
