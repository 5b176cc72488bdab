"""The dashboard in a browser: the delay of a scan, for one viewer and with many."""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any
from urllib.error import URLError

from benchmarks.control import Client
from benchmarks.effort import effort
from benchmarks.processes import roles
from benchmarks.rows import NotMeasured, Row, measurement
from benchmarks.stage import Stage, picture

SIDE, TIMES = 512, effort(12, 3)
VIEWERS, COUNTED_S = 20, effort(8.0, 0.0)
ALTERNATIONS, SETTLING_S, MEASURED_S = effort((7, 1.0, 3.0), (1, 0.1, 0.1))
WITHIN_S = 30.0
MS_PER_NS = 1e-6


@measurement
def dashboard() -> Iterator[Row]:
    """Measure from the publication of a scan until the browser has drawn it; both use the clock of one computer."""
    with _browser() as browser, Stage() as stage:
        page = open_page(browser, stage.url)
        late_ms = [latency_ms(page, stage, seed) for seed in range(TIMES)][2:]
        yield Row(f"scan of {SIDE}² on the page after its publication", "ms", statistics.median(late_ms), None, 150.0)
        yield Row(f"scan of {SIDE}² on the page, the slowest of {len(late_ms)}", "ms", max(late_ms), None, 300.0)
        with viewers(stage.url, VIEWERS):
            busy_s, begin_s = cpu_s(stage.process.pid), perf_counter()
            late_ms = [latency_ms(page, stage, seed) for seed in range(TIMES)][2:]
            while perf_counter() - begin_s < COUNTED_S:  # a scan a second, which few microscopes take
                late_ms.append(latency_ms(page, stage, len(late_ms)))
                page.wait_for_timeout(1000)
            share = (cpu_s(stage.process.pid) - busy_s) / (perf_counter() - begin_s)
        yield Row(f"the same while {VIEWERS} look on", "ms", statistics.median(late_ms), None, 150.0)
        yield Row(f"dashboard with {VIEWERS} viewers, a scan a second", "cores", share, None, 0.5)


@measurement
def looked_at() -> Iterator[Row]:
    """Measure the effect of many viewers on the experiment: a scan a second is published, and all are recorded."""
    with roles() as processes:
        publish, serve = processes.scheduler(*processes.start("translator", scan_every_s=1.0).split(), recorded=True)
        url = processes.dashboard(publish, serve)
        _wait_for_page(url)
        client = Client(processes, serve)
        looked_at, alone = [], []
        for _ in range(ALTERNATIONS):
            with viewers(url, VIEWERS):
                client.round_trips_us(SETTLING_S)
                looked_at.append(client.round_trips_us(MEASURED_S))
            client.round_trips_us(SETTLING_S)
            alone.append(client.round_trips_us(MEASURED_S))
    name = f"control round trip while {VIEWERS} look at the dashboard"
    for said, of in (("", statistics.median), (", on average", statistics.fmean)):
        ours, bare = (statistics.median(of(took) for took in each) for each in (looked_at, alone))
        yield Row(name + said, "µs", ours, bare, 1.05)


def _wait_for_page(url: str) -> None:
    deadline = perf_counter() + WITHIN_S
    while perf_counter() < deadline:
        try:
            with urllib.request.urlopen(url, timeout=WITHIN_S):
                return
        except URLError:
            threading.Event().wait(0.05)
    raise TimeoutError("the dashboard does not answer")


def latency_ms(page: Any, stage: Stage, seed: int, side: int = SIDE) -> float:
    """Publish one scan, and wait until it is drawn."""
    time_ns = stage.scan(picture(side, seed))
    page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{time_ns}'")
    return float(page.get_attribute(".picture", "data-at")) - time_ns * MS_PER_NS


def open_page(browser: Any, url: str) -> Any:
    """Return a page that has been drawn once."""
    page = browser.new_page(viewport={"width": 1400, "height": 1000})
    page.goto(url)
    page.wait_for_selector("text=is in control")
    page.wait_for_function("window.afspm?.image")
    return page


@contextmanager
def viewers(url: str, count: int) -> Iterator[None]:
    """Run `count` viewers while in the block, in a process of their own."""
    command = (sys.executable, "-m", "benchmarks.viewers", url, str(count))
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            if process.stdout.readline().strip() != "ready":
                raise RuntimeError("the viewers see nothing")
            yield
        finally:
            process.stdin.close()


def cpu_s(pid: int) -> float:
    """Return the processor time of a process so far (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def _browser() -> Iterator[Any]:
    program = os.environ.get("AFSPM_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        remedy = "install it (`apt install chromium`), or name it (AFSPM_CHROMIUM=/path)"
        raise NotMeasured("no chromium is found", remedy)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield started
        started.close()
