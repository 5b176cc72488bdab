"""After the experiment the page stays: the night can be looked through, and notes can be written."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from tests.ui.ui_lab import DEADLINE_S, Night, Opened

import afspm
from afspm.night.run import Run

MORE = """
[restart]
closing = "2 s"
"""
SCANS = 3
PLACES = "new Set([...document.querySelectorAll('.map [data-time]')].map((shape) => shape.dataset.time)).size"


@pytest.fixture(scope="module")
def ended(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Night]:
    """A night of a few scans that a person has viewed, and that has ended; the page stays."""
    # one scan of the series alone: on a slow computer the next would come before those of the test
    night = Night(tmp_path_factory.mktemp("ended"), speed=600.0, more=MORE, options=("--stay",), every="4000 h")
    try:
        context = browser.new_context()
        page = context.new_page()
        sign_in(page, night.url)
        with afspm.connect(night.folder, "tester") as scope:
            for number in range(SCANS):
                region = afspm.Region((number * 50e-9, 0.0), (1e-6, 1e-6))
                scan = scope.scan(region, shape=(32, 32), timeout_s=60.0).first
            page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{scan.time_ns}'")
            write_note(page, "<b>tip</b> changed here")
            page.wait_for_selector(".notes li")
            scope.note("the door slammed")
            pids = [one.pid for one in night.until(lambda: night.follower.overview.processes.values())]
            scope.end_experiment()
        night.wait_for(r"the dashboard is at \S+; press Ctrl-C to close it")
        assert not [pid for pid in pids if pid and is_running(pid)], "scheduler, translator and components are gone"
        # the page that was open is there again
        page.wait_for_function("window.afspm?.scrubber", timeout=DEADLINE_S * 1000)
        context.close()
        yield night
        night.process.send_signal(signal.SIGINT)
        assert night.process.wait(DEADLINE_S) == 0
    finally:
        night.close()


def sign_in(page: Any, url: str) -> None:
    page.goto(f"{url}/login")
    page.fill("#person", "Ada")
    page.click("button")
    page.wait_for_selector(".noted input")


def write_note(page: Any, text: str) -> None:
    page.fill(".noted input", text)
    page.click(".noted button:has-text('Note')")


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def record(night: Night) -> Run:
    return afspm.open_run(night.folder)


def look_at(page: Any, night: Night, number: int) -> int:
    """Go to the moment at which a scan was finished; return its time."""
    with record(night) as run:
        time_ns = run.numbered(number).time_ns
    page.wait_for_function("window.afspm?.scrubber")
    page.evaluate(f"window.afspm.scrubber.go(window.afspm.scrubber.times[{number - 1}])")
    page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{time_ns}'")
    return time_ns


def test_a_moment_of_the_night_is_shown_as_it_was(
    ended: Night, opened: Opened, keep: Callable[[Any, str], None]
) -> None:
    page = opened(ended.url, width=1440, height=900)
    look_at(page, ended, 1)
    page.wait_for_function(f"{PLACES} === 1")
    slider = page.locator("#scrubber input")
    slider.focus()
    page.keyboard.press("ArrowRight")
    with record(ended) as run:
        second = run.numbered(2).time_ns
    page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{second}'")
    page.wait_for_function(f"{PLACES} === 2")
    page.keyboard.press("End")
    page.wait_for_selector("text=AUTOMATED")
    keep(page, "recorded-night")


def test_time_of_each_moment_has_the_offset_in_force(ended: Night, opened: Opened) -> None:
    page = opened(ended.url)
    page.wait_for_function("window.afspm?.scrubber")
    shown = page.evaluate("""() => {
        const scrubber = window.afspm.scrubber, begin = scrubber.begin, middle = begin + 60_000_000_000n;
        scrubber.night.offsets = [[String(begin), 7200], [String(middle), 3600]];
        return [59_000, 61_000].map((ms) => {
            scrubber.go(ms);
            const utc_ms = Number(begin / 1_000_000n) + ms;
            return (Date.parse(`${scrubber.find("time").textContent.replace(" ", "T")}Z`) - utc_ms) / 1000;
        });
    }""")
    assert shown == pytest.approx([7200, 3600], abs=1.0)


def test_a_recorded_night_is_played(ended: Night, opened: Opened) -> None:
    page = opened(ended.url)
    look_at(page, ended, 1)
    page.click("#scrubber [data-part=play]")
    page.wait_for_function("Number(window.afspm.scrubber.slider.value) > window.afspm.scrubber.times[0] + 100")
    page.click("#scrubber [data-part=play]")
    assert page.get_attribute("#scrubber [data-part=play]", "aria-label") == "Play the night"


def test_two_scans_are_compared(ended: Night, opened: Opened, keep: Callable[[Any, str], None]) -> None:
    page = opened(ended.url, width=1440, height=900)
    for mode in ("side", "flicker", "difference"):
        page.click(f"[data-mode={mode}]")
        page.wait_for_selector(f"#compare[data-shown={mode}]")
    found = re.search(r"moved by \((\S+), (\S+)\)", page.inner_text("#compare [data-part=caption]").replace("−", "-"))
    assert found, page.inner_text("#compare [data-part=caption]")
    assert np.allclose([float(v) for v in found.groups()], [100.0, 0.0], atol=15.0), "the frames lie 100 nm apart"
    assert page.locator("#flipbook").count() == 0, "nothing corrected drift"
    keep(page, "recorded-difference")


def test_notes_of_the_night_and_of_the_morning_are_kept(ended: Night, opened: Opened) -> None:
    page = opened(ended.url, person="Eve")
    time_ns = look_at(page, ended, 2)
    write_note(page, "double tip")
    page.wait_for_selector(".notes li:has-text('double tip')")
    with record(ended) as run:
        notes = {note.text: note for note in run.notes}
        first, last = notes["<b>tip</b> changed here"], notes["double tip"]
        assert (first.who, first.scan) == ("dashboard:Ada", run.scans[-1].number)
        assert (last.who, last.scan, last.time_ns) == ("dashboard:Eve", 2, time_ns)
    assert page.locator(".notes b b").count() == 0, "text is no markup"
    assert page.locator("#scrubber .marks .note").count() >= 2
    page.wait_for_selector("text=Noted")  # once the report is written again
    report = page.request.get(f"{ended.url}/night/report")
    assert report.ok
    assert "double tip" in report.text()
    assert "&lt;b&gt;tip&lt;/b&gt; changed here" in report.text()


def test_a_recorded_night_can_not_be_steered(ended: Night, opened: Opened) -> None:
    page = opened(ended.url, person="Eve")
    page.wait_for_function("window.afspm?.scrubber")
    assert not page.locator("button:has-text('Take over'):visible").count()
    assert not page.locator("button:has-text('Restart'):visible").count()
    assert not page.locator("button:has-text('Scan here'):visible").count()


def test_a_recorded_night_fits_a_phone(ended: Night, opened: Opened, keep: Callable[[Any, str], None]) -> None:
    page = opened(ended.url, width=390, height=844)
    look_at(page, ended, 2)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    keep(page, "recorded-phone")
