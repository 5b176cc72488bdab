"""The report in a browser: pictures enlarge and close, nothing is wider than the screen."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from afspm import model, wire
from afspm.record.store import RecordSettings, RecordStore
from afspm.report.night_report import write

START = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The address of the report of a run with scans and spectra."""
    folder = tmp_path_factory.mktemp("report")
    store = RecordStore(folder, RecordSettings({"experiment": "a_name_that_is_long_and_has_no_spaces_in_it"}))
    bias = np.linspace(-1.0, 1.0, 40)
    for number in range(1, 5):
        time_ns = START + number * 1_000_000_000
        place = (number * 1e-9, 0.0)
        values = np.random.default_rng(number).normal(size=(32, 32)) * 1e-9
        scan = model.Scan(model.Region(place, (2e-6, 1e-6)), "Height", "m", values, time_ns, f"{number}.sxm")
        curve = model.Spectrum(
            place, "IV", ("Bias", "Current"), ("V", "A"), np.stack([bias, bias * number], axis=1), time_ns, f"{number}"
        )
        for envelope, thing, later_ns in (("Scan2d_Height", scan, 0), ("Spec1d_IV", curve, 1000)):
            store.take([(model.Packet(envelope, wire.encode(thing)[1], time_ns + later_ns), "")])
    store.flush()
    store.close()
    return write(folder).as_uri()


@pytest.fixture(params=[(1280, 900), (390, 844)], ids=["wide", "phone"])
def page(browser: Any, report: str, request: pytest.FixtureRequest) -> Any:
    width, height = request.param
    context = browser.new_context(viewport={"width": width, "height": height})
    opened = context.new_page()
    opened.goto(report)
    yield opened
    context.close()


def test_nothing_is_wider_than_the_screen(page: Any) -> None:
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_a_picture_enlarges_on_a_click_and_steps_to_the_next_and_closes(page: Any) -> None:
    small = page.locator("#scan-2 img").bounding_box()["width"]
    page.click("#scan-2 .open")
    assert page.locator("#scan-2 img").bounding_box()["width"] > 2.5 * small
    assert page.locator("#scan-2 dl").is_visible()
    page.click("#scan-2 >> text=next")
    assert page.locator("#scan-3 dl").is_visible()
    assert not page.locator("#scan-2 dl").is_visible()
    page.click("#scan-3 >> text=close")
    assert page.locator("#scan-3 img").bounding_box()["width"] == pytest.approx(small, abs=1)


def test_a_scan_on_the_map_leads_to_its_picture(page: Any) -> None:
    page.locator(".map > a").last.click(position={"x": 5, "y": 5})
    assert page.locator("#scan-4 dl").is_visible()
    page.go_back()
    assert not page.locator("#scan-4 dl").is_visible()


def test_a_curve_enlarges_with_its_axes(page: Any) -> None:
    label = page.locator("#spectrum-1-3 .open text", has_text="Current").first
    assert not label.is_visible()
    page.click("#spectrum-1-3 .open")
    assert label.is_visible()
