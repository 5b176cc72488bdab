"""Photographs the dashboard of a simulated night: `python tools/dashboard_picture.py [FOLDER]`.

Without a folder it draws docs/pictures/dashboard.png, and recorded-night.png of the same night when it is over; with
one it leaves there what a person sees on three screens, light and dark, signed in and not. Needs chromium and
playwright, as the tests in tests/ui do.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
ADDRESS = r"the dashboard (?:is|stays) at (\S+?);?\s"
PICTURES = ROOT / "docs" / "pictures"
SCREENS = {"wide": (1440, 900), "tablet": (1024, 768), "phone": (390, 844)}
AFSPM = (sys.executable, "-c", "from afspm.cli import main; main()")
EXPERIMENT = """
[clock]
start = 2026-03-14T20:00:00Z
speed = 120.0

[microscope]
component = true
class = "Simulator"
seed = 7
surface = { kind = "particles" }
tip_changes = { schedule = [[1_500, "double"]], pulse_cures = 1.0 }
initial = { scan-speed = "10 um/s" }
live_lines_s = 20.0

[scheduler]
component = true
class = "Scheduler"

[random_points]
component = true
class = "points.RandomPoints"
around = "600 nm"

[best_points]
component = true
class = "points.BestPoints"
size = "3 um"
narrow = "600 nm"
rounds = 40

[tip_classifier]
component = true
class = "TipClassifier"

[tip_corrector]
component = true
class = "TipCorrector"
workshop_center = ["8 um", "0 um"]
test_center = ["0 um", "4 um"]

[metadata]
component = true
class = "Metadata"

[limits]
region = { x = ["-15 um", "15 um"], y = ["-15 um", "15 um"] }

[dashboard]
component = true
class = "Dashboard"
port = 0
"""


@contextmanager
def running_night(folder: Path) -> Iterator[str]:
    """Run the experiment; gives the address of its dashboard."""
    (folder / "survey.toml").write_text(EXPERIMENT, encoding="utf-8")
    shutil.copy(ROOT / "experiments" / "best_points" / "points.py", folder)
    with serving((*AFSPM, "run", str(folder / "survey.toml"), "--runs", str(folder / "runs")), folder) as url:
        yield url


@contextmanager
def serving(command: tuple[str, ...], folder: Path) -> Iterator[str]:
    """Run a command; gives the address of its dashboard."""
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        lines = iter(process.stdout)
        try:
            yield next(found[1] for line in lines if (found := re.search(ADDRESS, line)))
        finally:
            process.terminate()
            process.communicate()


def open_page(browser: Browser, url: str, screen: str, theme: Any = "light", person: str = "") -> Any:
    """Return the page in a window of its own."""
    width, height = SCREENS[screen]
    window = browser.new_context(viewport={"width": width, "height": height}, color_scheme=theme, has_touch=width < 500)
    page = window.new_page()
    page.set_default_timeout(60_000)
    page.goto(f"{url}/login" if person else url)
    if person:
        page.fill("#person", person)
        page.click("button")
    page.wait_for_selector("text=is in control")
    page.wait_for_function("document.querySelector('.picture').dataset.number")
    return page


def wait_for_scans(page: Any, places: int) -> None:
    """Wait until scans of so many places are on the map."""
    page.wait_for_function(f"document.querySelectorAll('.map .scan').length >= {places}", timeout=300_000)


def photograph_all(browser: Browser, url: str, folder: Path) -> None:
    """Leave a picture of each screen and theme, as far as one scrolls."""
    folder.mkdir(parents=True, exist_ok=True)
    for screen in SCREENS:
        for person, theme in (("", "light"), ("", "dark"), ("Ada", "light"), ("Ada", "dark")):
            page = open_page(browser, url, screen, theme, person)
            name = f"{screen}-{theme}{'-signed-in' if person else ''}"
            for part in parts_of(page, screen):
                page.wait_for_timeout(1500)
                page.screenshot(path=folder / f"{name}-{part}.png")
            page.context.close()


def parts_of(page: Any, screen: str) -> Iterator[str]:
    """Show one part of the page after the other."""
    if screen == "phone":
        for tab in page.locator("[role=tab]").all():
            tab.click()
            yield tab.inner_text().lower()
    else:
        yield "top"
        page.mouse.move(700, 600)
        page.evaluate("window.scrollTo(0, document.body.scrollHeight)")
        yield "further"


def photograph_recorded(browser: Browser, url: str) -> None:
    """Draw the page of a recorded night, at a moment in its middle."""
    page = open_page(browser, url, "wide")
    page.wait_for_function("window.afspm.scrubber")
    page.evaluate("window.afspm.scrubber.go(0.6 * window.afspm.scrubber.last)")
    page.wait_for_timeout(3000)
    page.screenshot(path=PICTURES / "recorded-night.png")


def main() -> None:
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        folder = Path(scratch)
        program = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        with running_night(folder) as url:
            page = open_page(browser, url, "wide")
            wait_for_scans(page, 7)
            if len(sys.argv) > 1:
                photograph_all(browser, url, Path(sys.argv[1]))
                return
            page.screenshot(path=PICTURES / "dashboard.png")
        with serving((*AFSPM, "dashboard", str(folder / "runs"), "--port", "0"), folder) as url:
            photograph_recorded(browser, url)


if __name__ == "__main__":
    main()
