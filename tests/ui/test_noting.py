"""A note is on the scan that its author saw, even if the next scan ends while the note is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.ui.ui_lab import Night, Opened

import afspm
from afspm.model import ScopeState, names


def take_scan(night: Night) -> None:
    before = night.follower.overview.scan_count
    with afspm.connect(night.folder, "holder") as scope, scope.control():
        scope.action(names.START_SCAN)
        night.until(lambda: night.follower.overview.scan_count > before)
        night.until(lambda: night.state is ScopeState.FREE)


def wait_for_picture(page: Any, number: int) -> None:
    page.wait_for_selector(f"[data-part=facts] dd:text-is('no. {number}')")


def test_note_stays_on_the_scan_shown_when_it_was_begun(browser: Any, tmp_path: Path, opened: Opened) -> None:
    night = Night(tmp_path, lines=0)
    try:
        page = opened(night.url, person="Ada")
        night.until(lambda: night.follower.overview.scans)
        night.until(lambda: night.state is ScopeState.FREE)
        wait_for_picture(page, 1)
        page.locator(".noted input[aria-label=note]").press_sequentially("double tip")
        take_scan(night)
        wait_for_picture(page, 2)
        page.locator(".noted input[aria-label=note]").press("Enter")
        page.wait_for_selector("text=Noted on scan 1.")
        (note,) = night.until(lambda: night.follower.overview.notes)
        assert note.scan_ns == night.follower.overview.scans[0].time_ns
        page.locator(".noted input[aria-label=note]").press_sequentially("good again")
        page.locator(".noted input[aria-label=note]").press("Enter")
        page.wait_for_selector("text=Noted on scan 2.")
    finally:
        night.close()
