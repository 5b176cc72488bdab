"""The page of instruments agrees with the reports of the drivers."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.basics import entry_points
from afspm.basics.errors import FileError
from afspm.testing.commissioning.progress import outcome_of
from afspm.testing.commissioning.report import InstrumentReport
from afspm.testing.commissioning.steps import OPERATIONS
from afspm.translator.judge import WITNESSES

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "instruments.md"
FOLDERS = [entry_points.folder(entry_points.DRIVERS, name) for name in entry_points.names(entry_points.DRIVERS)]
REPORTS = [file for folder in FOLDERS if folder is not None for file in sorted(folder.glob("reports/*.toml"))]


def test_reports_are_found() -> None:
    assert len(REPORTS) >= 4


@pytest.mark.parametrize("file", REPORTS, ids=lambda file: f"{file.parents[1].name}-{file.stem}")
def test_report_has_known_outcomes_of_known_operations(file: Path) -> None:
    report = InstrumentReport.read(file)
    assert set(report.operations) <= set(OPERATIONS)
    assert {outcome_of(outcome) for outcome in report.operations.values()}
    assert report.release in PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", [PAGE, ROOT / "README.md"], ids=lambda page: page.name)
def test_page_admits_that_no_instrument_was_tried(page: Path) -> None:
    tried = [file for file in REPORTS if InstrumentReport.read(file).tried_on == "instrument"]
    first_screen = "\n".join(page.read_text(encoding="utf-8").splitlines()[:12])
    assert ("Emulated only so far" in first_screen) == (not tried)


@pytest.mark.parametrize("change", [("tried_on = ", 'tried_on = "hearsay" # '), ("format = 1", "format = 99")])
def test_malformed_report_is_refused(change: tuple[str, str], tmp_path: Path) -> None:
    file = tmp_path / "report.toml"
    file.write_text(REPORTS[0].read_text(encoding="utf-8").replace(*change), encoding="utf-8")
    with pytest.raises(FileError, match="not a commissioning report"):
        InstrumentReport.read(file)


def test_each_maker_shows_a_witness_or_says_why_not() -> None:
    page = PAGE.with_name("what-proves-a-result.md").read_text(encoding="utf-8").partition("| witness | `Asylum`")[2]
    rows = [[cell.strip() for cell in row.strip("|").split("|")] for row in page.splitlines() if row.startswith("| ")]
    makers = ["Asylum", "Gxsm", "Nanonis", "Nanosurf", "Park", "Simulator"]
    assert [name for name, *_ in rows[1:]] == list(WITNESSES)
    assert all(cells.count("") == 0 and len(cells) >= 1 + len(makers) for cells in rows[1:])
    known = {name for name, shown_by in WITNESSES.items() if not shown_by}
    for maker in makers:  # a parameter is shown by the table, and not declared twice
        assert entry_points.load(entry_points.DRIVERS, maker).never_shows.keys() <= known
