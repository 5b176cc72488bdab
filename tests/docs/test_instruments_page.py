"""The page of instruments says no more than its reports, and no less."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.basics import entry_points
from afspm.basics.errors import FileError
from afspm.testing.commissioning.progress import outcome_of
from afspm.testing.commissioning.report import InstrumentReport
from afspm.testing.commissioning.steps import OPERATIONS

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "instruments.md"
FOLDERS = [entry_points.folder(entry_points.DRIVERS, name) for name in entry_points.names(entry_points.DRIVERS)]
REPORTS = [file for folder in FOLDERS if folder is not None for file in sorted(folder.glob("reports/*.toml"))]


def test_there_are_reports() -> None:
    assert len(REPORTS) >= 4


@pytest.mark.parametrize("file", REPORTS, ids=lambda file: f"{file.parents[1].name}-{file.stem}")
def test_a_report_tells_known_outcomes_of_known_operations(file: Path) -> None:
    report = InstrumentReport.read(file)
    assert set(report.operations) <= set(OPERATIONS)
    assert {outcome_of(outcome) for outcome in report.operations.values()}
    assert report.release in PAGE.read_text(encoding="utf-8")


def test_the_page_says_plainly_that_nobody_has_tried_an_instrument_as_long_as_it_is_true() -> None:
    tried = [file for file in REPORTS if InstrumentReport.read(file).tried_on == "instrument"]
    assert ("Nobody has tried afspm on a real instrument yet" in PAGE.read_text(encoding="utf-8")) == (not tried)


@pytest.mark.parametrize("change", [("tried_on = ", 'tried_on = "hearsay" # '), ("format = 1", "format = 99")])
def test_what_is_no_report_is_refused(change: tuple[str, str], tmp_path: Path) -> None:
    file = tmp_path / "report.toml"
    file.write_text(REPORTS[0].read_text(encoding="utf-8").replace(*change), encoding="utf-8")
    with pytest.raises(FileError, match="not a commissioning report"):
        InstrumentReport.read(file)
