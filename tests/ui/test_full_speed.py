"""At any rate of messages the page shows the newest, and its memory does not grow."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from benchmarks.dashboard import latency_ms, open_page
from benchmarks.stage import REGION, Stage, picture

from afspm.model import LogLine, LogLines, ScanLines, ScopeState, ScopeStatus

MB = 1 << 20


@pytest.fixture(scope="module")
def stage(browser: Any) -> Iterator[Stage]:
    with Stage() as stage:
        yield stage


@pytest.fixture
def page(browser: Any, stage: Stage) -> Iterator[Any]:
    page = open_page(browser, stage.url)
    page.set_default_timeout(15_000)
    yield page
    page.close()


def heap_bytes(page: Any) -> float:
    """Return the size of the page's JavaScript heap, without garbage."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    return float(session.send("Runtime.getHeapUsage")["usedSize"])


def test_a_scan_is_on_the_page_soon(stage: Stage, page: Any) -> None:
    late_ms = sorted(latency_ms(page, stage, seed) for seed in range(8))
    assert late_ms[len(late_ms) // 2] < 150.0


def test_at_full_speed_the_newest_scan_is_shown_and_others_are_skipped(stage: Stage, page: Any) -> None:
    values = picture(1024)
    page.evaluate(
        """() => {
          window.drawn = 0;
          new MutationObserver(() => window.drawn++).observe(document.querySelector(".picture"), { attributeFilter: ["data-number"] });
        }"""  # noqa: E501
    )
    end_s = time.monotonic() + 4.0
    published = 0
    while time.monotonic() < end_s:
        last_ns = stage.scan(values)
        published += 1
    page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{last_ns}'", timeout=3000)
    assert 1 <= page.evaluate("window.drawn") < published


def test_a_night_of_messages_does_not_grow_the_memory(stage: Stage, page: Any) -> None:
    """As many messages as in 8 hours with one line, state and log line every 4 s, within seconds; twice, to compare."""
    sizes = []
    for half in range(2):
        for i in range(3600):
            began_ns, row = (half * 3600 + i - i % 128 + 1) * 10**9, i % 128
            stage.publish(ScanLines(REGION, (128, 128), "Phase", "m", row, np.full((1, 128), 1e-9 * i), began_ns))
            stage.publish(ScopeStatus(ScopeState.SCANNING if i % 2 else ScopeState.FREE))
            stage.publish(LogLines((LogLine(stage.clock.now_ns(), "series", "INFO", f"line {half} {i}; " + "x" * 60),)))
            if i % 900 == 899:  # a publisher drops what more than some thousands behind can't be kept
                page.wait_for_selector(f"ul.log >> text=line {half} {i};")
        sizes.append((heap_bytes(page), stage.memory_bytes()))
    assert sizes[1][0] - sizes[0][0] < 4 * MB
    assert sizes[1][1] - sizes[0][1] < 24 * MB


def test_a_stalled_browser_does_not_delay_others(stage: Stage, browser: Any, page: Any) -> None:
    frozen = open_page(browser, stage.url)
    frozen.evaluate("setTimeout(() => { const end = Date.now() + 6000; while (Date.now() < end); }, 0)")
    before, end_s = stage.memory_bytes(), time.monotonic() + 5.0
    late_ms: list[float] = []
    while time.monotonic() < end_s:
        late_ms.append(latency_ms(page, stage, len(late_ms)))
    assert sorted(late_ms)[len(late_ms) // 2] < 300.0
    assert stage.memory_bytes() - before < 120 * MB  # scans are kept up to a limit, and nothing else
    last = page.get_attribute(".picture", "data-time")
    frozen.wait_for_function(f"document.querySelector('.picture').dataset.time === '{last}'", timeout=15_000)
    frozen.close()
