"""The page shows CRITICAL messages until they are over: a full disk, and a message of a component."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from small_disk import fill, small_disk
from tests.ui.ui_lab import Night, Opened

from afspm.report.night_report import REPORT_FILE


def test_message_is_a_banner_until_it_is_over_and_a_viewer_may_hide_it(night: Night, opened: Opened) -> None:
    page, other = opened(night.url), opened(night.url)
    banner, off = ".alarms .flag:has-text('the pump is off: <no current>')", night.folder / "pump-off"
    off.touch()
    for one in (page, other):
        one.wait_for_selector(banner)
    page.click(".alarms button:has-text('Seen')")
    page.wait_for_selector(banner, state="detached")
    assert other.locator(banner).count() == 1
    off.unlink()
    other.wait_for_selector(banner, state="detached")
    off.touch()
    page.wait_for_selector(banner)  # another outage, which was not seen yet
    off.unlink()
    page.wait_for_selector(banner, state="detached")


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Path]:
    """A folder whose run folders have a small disk of their own."""
    with small_disk(tmp_path / "runs"):
        yield tmp_path


def test_full_disk_is_a_banner_until_there_is_room_and_stands_in_the_report(
    browser: Any, small: Path, opened: Opened, keep: Any
) -> None:
    night = Night(small)
    try:
        page, filler = opened(night.url), small / "runs" / "filler"
        page.wait_for_selector(".alarms", state="hidden")
        fill(filler)
        banner = ".alarms .flag:has-text('nothing can be recorded')"
        page.wait_for_selector(banner)
        keep(page, "full-disk")
        filler.unlink()
        page.wait_for_selector(banner, state="detached")
    finally:
        night.close()
    report = (night.folder / REPORT_FILE).read_text(encoding="utf-8")
    assert "<h2>Critical messages</h2>" in report
    assert "nothing can be recorded" in report
