"""At any rate of messages the page shows the newest, and its memory does not grow.

How soon a scan is on the page is measured by the benchmark (`benchmarks/dashboard.py`): no verdict depends on speed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from benchmarks.dashboard import latency_ms, open_page
from benchmarks.stage import REGION, Stage, picture
from tests.ui.ui_lab import DEADLINE_S

from afspm.model import LogLine, ScanLines, ScopeState, ScopeStatus
from afspm.model.events import LogLines

MB = 1 << 20
AT_ONCE = 60
"""As many scans are published one after the other."""


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


def heap_bytes(page: Any) -> float:
    """Return the size of the page's JavaScript heap, without garbage."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    return float(session.send("Runtime.getHeapUsage")["usedSize"])


@contextmanager
def stalled(page: Any) -> Iterator[None]:
    """Stop a page's script at its next statement, which a message brings; it goes on after the block."""
    debugger = page.context.new_cdp_session(page)
    debugger.send("Debugger.enable")
    debugger.send("Debugger.pause")
    yield
    debugger.send("Debugger.resume")
    debugger.send("Debugger.disable")


def test_at_full_speed_the_newest_scan_is_shown_and_others_are_skipped(stage: Stage, page: Any) -> None:
    values = picture(1024)
    page.evaluate(
        """() => {
          window.drawn = 0;
          new MutationObserver(() => window.drawn++).observe(document.querySelector(".picture"), { attributeFilter: ["data-number"] });
        }"""  # noqa: E501
    )
    last_ns = 0
    with stalled(page):
        for _ in range(AT_ONCE):
            last_ns = stage.scan(values)
    page.wait_for_function(
        f"document.querySelector('.picture').dataset.time === '{last_ns}'", timeout=DEADLINE_S * 1000
    )
    assert 1 <= page.evaluate("window.drawn") < AT_ONCE


def test_a_night_of_messages_does_not_grow_the_memory(stage: Stage, page: Any) -> None:
    """As many messages as in 8 hours with one line, state and log line every 4 s, within seconds; twice, to compare.

    On a busy computer more messages wait at once, and memory that held them is kept: a leak grows with each repetition.
    """
    sizes: list[tuple[float, int]] = []
    for half in range(5):
        for i in range(3600):
            began_ns, row = (half * 3600 + i - i % 128 + 1) * 10**9, i % 128
            stage.publish(ScanLines(REGION, (128, 128), "Phase", "m", row, np.full((1, 128), 1e-9 * i), began_ns))
            stage.publish(ScopeStatus(ScopeState.SCANNING if i % 2 else ScopeState.FREE))
            stage.publish(LogLines((LogLine(stage.clock.now_ns(), "series", "INFO", f"line {half} {i}; " + "x" * 60),)))
            if i % 900 == 899:  # a publisher drops what more than some thousands behind can't be kept
                page.wait_for_selector(f"ul.log >> text=line {half} {i};")
        sizes.append((heap_bytes(page), stage.memory_bytes()))
        if half and sizes[-1][0] - sizes[-2][0] < 4 * MB and sizes[-1][1] - sizes[-2][1] < 24 * MB:
            return
    pytest.fail(f"the memory of the page and of the dashboard grew each time: {sizes}")


def test_a_stalled_browser_does_not_delay_others(stage: Stage, browser: Any, page: Any) -> None:
    frozen = open_page(browser, stage.url)
    frozen.set_default_timeout(DEADLINE_S * 1000)
    before = stage.memory_bytes()
    with stalled(frozen):
        for seed in range(8):
            latency_ms(page, stage, seed)  # returns once the scan is on the page
    assert stage.memory_bytes() - before < 120 * MB  # scans are kept up to a limit, and nothing else
    last = page.get_attribute(".picture", "data-time")
    frozen.wait_for_function(f"document.querySelector('.picture').dataset.time === '{last}'")
    frozen.close()
