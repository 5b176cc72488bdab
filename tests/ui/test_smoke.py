"""The part of these tests that runs with all others: a scan is shown, and a person takes over and hands back."""

from __future__ import annotations

from tests.ui.ui_lab import Night, Opened

import afspm
from afspm.model import ControlMode


def test_a_scan_is_seen_and_a_person_takes_over_and_hands_back(night: Night, opened: Opened) -> None:
    page = opened(night.url, person="Ada")
    with afspm.connect(night.folder, "tester") as scope:
        scan = scope.scan(shape=(16, 20), timeout_s=60.0).first
    page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{scan.time_ns}'")
    page.locator(".picture").focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_selector(".readout[data-column='11'][data-row='8']")
    assert float(page.get_attribute(".readout", "data-value")) == scan.values[8, 11]
    page.click("button:has-text('Take over: MANUAL')")
    night.until(lambda: night.control().mode is ControlMode.MANUAL)
    page.click("button:has-text('Hand back: AUTOMATED')")
    night.until(lambda: night.control().mode is ControlMode.AUTOMATED)
