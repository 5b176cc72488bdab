"""Drawings of guests on the page: the row of a tip change, curves of other instruments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from benchmarks.dashboard import open_page
from benchmarks.stage import REGION, Stage
from tests.ui.ui_lab import DEADLINE_S

from afspm.components.tip_verdict import OF_LINES, LineVerdict, line_verdict_message
from afspm.model import InstrumentReading, InstrumentReadings, Scan, ScanLines, ScopeState, ScopeStatus

ROWS, NEWEST, CHANGED = 128, 80, 62
BRIGHT_ROW = """row => {
  const { canvas, geometry } = window.afspm.image;
  const at = geometry.toScreen(geometry.fromPixel([0, row]))[1], { box } = geometry;
  const scale = canvas.width / canvas.getBoundingClientRect().width;
  const beyond = 220 * scale; // right of the words
  const width = Math.floor(0.9 * (box.width * scale - beyond)), height = 5; // the line may lie between two pixels
  const { data } = canvas.getContext("2d").getImageData(
    Math.round(box.x * scale + beyond), Math.floor(at * scale) - 2, width, height);
  const white = Array(width).fill(false);
  for (let i = 0; i < data.length; i += 4) {
    white[(i / 4) % width] ||= Math.min(data[i], data[i + 1], data[i + 2]) > 180;
  }
  return white;
}"""


@pytest.fixture(scope="module")
def stage(browser: Any) -> Iterator[Stage]:
    with Stage() as stage:
        yield stage


@pytest.fixture
def page(browser: Any, stage: Stage) -> Iterator[Any]:
    page = open_page(browser, stage.url)
    page.set_default_timeout(DEADLINE_S * 1000)
    yield page
    page.close()


def dashes(page: Any, row: int) -> tuple[float, int]:
    """Return the white share of a row of the picture on the page, and the number of its white pieces."""
    white = np.array(page.evaluate(BRIGHT_ROW, row), dtype=np.int8)
    return float(white.mean()), int(np.sum(np.diff(white) == 1))


def test_changed_row_is_a_dashed_line_while_the_scan_runs_and_afterwards(
    stage: Stage, page: Any, keep: Callable[[Any, str], None]
) -> None:
    # dark, so that no pixel of the picture itself is white
    values = np.tile(np.linspace(0.0, 1e-9, ROWS), (ROWS, 1))
    values[:, -3:] = 50e-9
    began_ns = stage.clock.now_ns()
    stage.publish(ScopeStatus(ScopeState.SCANNING))
    stage.publish(ScanLines(REGION, (ROWS, ROWS), "Height", "m", 0, values[:NEWEST], began_ns))
    page.wait_for_function("window.afspm.image.head?.newest_row > 0")
    assert dashes(page, CHANGED) == (0.0, 0)
    verdict = LineVerdict(REGION, (ROWS, ROWS), "Height", began_ns, NEWEST - 1, CHANGED, False, 0.99, True, "other")
    stage.publish(line_verdict_message(verdict), f"{OF_LINES}_line_watch")
    page.wait_for_function(f"window.afspm.image.head?.changed_row === {CHANGED}")
    page.wait_for_function("document.querySelector('.picture').dataset.number")
    keep(page, "tip-change")
    share, pieces = dashes(page, CHANGED)
    assert 0.3 < share < 0.8
    assert pieces > 5
    assert dashes(page, CHANGED - 10) == (0.0, 0)
    time_ns = stage.clock.now_ns()
    stage.publish(Scan(REGION, "Height", "m", values, time_ns), "Scan2d_Height")
    page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{time_ns}'")
    assert dashes(page, CHANGED)[1] > 5


def test_curve_of_another_instrument_has_its_full_height(
    stage: Stage, page: Any, keep: Callable[[Any, str], None]
) -> None:
    for kelvin in (4.2, 4.5, 4.3):
        now_ns = stage.clock.now_ns()
        reading = InstrumentReading("cryo.temperature", kelvin, "K", 0.0)
        stage.publish(InstrumentReadings(now_ns, "cryo", (reading,)), "InstrumentReadings_cryo")
    curve = page.locator(".time .curve svg")
    curve.wait_for()
    page.wait_for_function("document.querySelector('.time .curve polyline')?.points.length >= 2")
    assert curve.bounding_box()["height"] > 50
    keep(page, "curve")
