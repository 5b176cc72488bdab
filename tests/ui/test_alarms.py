"""The page shows CRITICAL messages until they are over: a full disk, and a message of a component."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from small_disk import fill, small_disk
from tests.ui.ui_lab import Night, Opened

from afspm.record.report import REPORT_FILE

PUMP = """
from afspm import Component


class Pump(Component):
    period_s = 0.1
    period_time = "real"

    def on_tick(self):
        is_on = (self.run_dir / "on").exists()
        if is_on != self.memory.get("is_on", True):
            self.memory["is_on"] = is_on
            if is_on:
                self.log.info("the pump runs; no longer true: the pump is off")
            else:
                self.log.critical("the pump is off: <no current>")
"""
MORE = """
[pump]
component = true
class = "pump.Pump"
"""


def test_message_is_a_banner_until_it_is_over_and_a_viewer_may_hide_it(
    browser: Any, tmp_path: Path, opened: Opened
) -> None:
    (tmp_path / "pump.py").write_text(PUMP, encoding="utf-8")
    night = Night(tmp_path, more=MORE)
    try:
        page, other = opened(night.url), opened(night.url)
        banner = ".alarms .flag:has-text('the pump is off: <no current>')"
        for one in (page, other):
            one.wait_for_selector(banner)
        page.click(".alarms button:has-text('Seen')")
        page.wait_for_selector(banner, state="detached")
        assert other.locator(banner).count() == 1
        (night.folder / "on").touch()
        other.wait_for_selector(banner, state="detached")
        (night.folder / "on").unlink()
        page.wait_for_selector(banner)  # another outage, which was not seen yet
    finally:
        night.close()


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
        page.wait_for_selector(banner, timeout=80_000)
        keep(page, "full-disk")
        filler.unlink()
        page.wait_for_selector(banner, state="detached", timeout=80_000)
    finally:
        night.close()
    report = (night.folder / REPORT_FILE).read_text(encoding="utf-8")
    assert "<h2>Critical messages</h2>" in report
    assert "nothing can be recorded" in report
