"""A note is on the scan that its author saw, even if the next scan ends while the note is written."""

from __future__ import annotations

from typing import Any

from tests.ui.ui_lab import Night, Opened

import afspm


def take_scan(night: Night, rows: int) -> int | None:
    """Take a scan of `rows` lines; return its time."""
    with afspm.connect(night.folder, "holder") as scope:
        return scope.scan(shape=(rows, 16), timeout_s=60.0).first.time_ns


def number_shown(page: Any, rows: int) -> int:
    """Wait for the facts of a scan of `rows` lines; return its number."""
    facts = page.locator("[data-part=facts]")
    facts.locator(f"dd:text-is('16 × {rows}')").wait_for()
    return int(facts.locator("dd:text-matches('^no[.] [0-9]+$')").inner_text().removeprefix("no. "))


def test_note_stays_on_the_scan_shown_when_it_was_begun(night: Night, opened: Opened) -> None:
    page = opened(night.url, person="Ada")
    note = page.locator(".noted input[aria-label=note]")
    time_ns = take_scan(night, 18)
    number = number_shown(page, 18)
    note.press_sequentially("double tip")
    take_scan(night, 22)
    assert number_shown(page, 22) == number + 1
    note.press("Enter")
    page.wait_for_selector(f"text=Noted on scan {number}.")
    noted = night.until(lambda: next((one for one in night.follower.overview.notes if one.text == "double tip"), None))
    assert noted.scan_ns == time_ns
    note.press_sequentially("good again")
    note.press("Enter")
    page.wait_for_selector(f"text=Noted on scan {number + 1}.")
