"""The page shows a killed dashboard, a killed scheduler, and the end of the experiment."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from afspm_process import AFSPM
from tests.ui.ui_lab import DEADLINE_S, EXPERIMENT, Night, Opened

from afspm.model import ProcessCondition


@pytest.fixture(scope="module")
def night(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Night]:
    """A night of these tests alone: they kill its processes, and end it."""
    one = Night(tmp_path_factory.mktemp("lost"))
    yield one
    one.close()


def pid_of(night: Night, name: str) -> int:
    state = night.until(lambda: (s := night.follower.overview.processes.get(name)) and s.pid and s)
    return int(state.pid)


def test_a_killed_dashboard_is_back_at_the_same_address_and_so_is_the_page(
    night: Night, opened: Opened, keep: object
) -> None:
    page = opened(night.url, person="Ada")
    page.wait_for_selector("[role=rowheader]")
    before = pid_of(night, "dashboard")
    os.kill(before, signal.SIGKILL)
    page.wait_for_selector("#trouble:has-text('connection to the dashboard is lost')")
    night.until(lambda: night.follower.overview.processes["dashboard"].pid not in (0, before))
    page.wait_for_selector("#trouble", state="hidden")
    page.wait_for_selector("nav.who:has-text('Ada')")  # who has signed in stays so
    page.wait_for_selector("text=is in control")
    # out of the record: it was not there to see that
    lane = ".lane:has(b:text-is('dashboard'))"
    page.wait_for_selector(f"{lane} .process-alive ~ .process-starting ~ .process-alive", state="attached")


def test_old_data_are_marked(night: Night, opened: Opened) -> None:
    page = opened(night.url)
    page.wait_for_selector("#trouble", state="hidden")
    # the supervisor, too: together they are a frozen computer
    frozen = (night.process.pid, pid_of(night, "scheduler"))
    for pid in frozen:
        os.kill(pid, signal.SIGSTOP)
    try:
        page.wait_for_selector("#trouble:has-text('The experiment has been silent for')")
    finally:
        for pid in reversed(frozen):
            os.kill(pid, signal.SIGCONT)
    page.wait_for_selector("#trouble", state="hidden")


def test_microscope_without_an_answer_does_not_stop_the_page(night: Night, opened: Opened) -> None:
    page = opened(night.url, person="Ada")
    # the supervisor, too: it would replace the microscope
    frozen = (night.process.pid, pid_of(night, "microscope"))
    for pid in frozen:
        os.kill(pid, signal.SIGSTOP)
    try:
        page.click("button:has-text('Take over')")  # and the page reads the parameters
        page.wait_for_selector("[data-part=mode]:text-is('MANUAL')")
        updated_ms = []
        for _ in range(10):
            page.wait_for_timeout(1000)
            updated_ms.append(page.evaluate("Date.now() - window.afspm.updated"))
    finally:
        for pid in reversed(frozen):
            os.kill(pid, signal.SIGCONT)
    assert max(updated_ms) < 4000
    page.click("button:has-text('Hand back')")
    page.wait_for_selector("[data-part=mode]:text-is('AUTOMATED')")
    page.wait_for_selector("#trouble", state="hidden")


def test_a_page_that_joined_a_run_shows_a_lost_scheduler(opened: Opened, tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT.partition("[dashboard]")[0].format(speed=60.0, lines=2.0, every="4 h"), encoding="utf-8")
    with ExitStack() as started:

        def start(*words: object) -> subprocess.Popen[str]:
            command = (*AFSPM, *map(str, words))
            process = started.enter_context(
                subprocess.Popen(command, stdout=subprocess.PIPE, encoding="utf-8", cwd=tmp_path)
            )
            started.callback(process.terminate)
            return process

        def last_word(process: subprocess.Popen[str], wanted: str) -> str:
            assert process.stdout is not None
            return next(line for line in process.stdout if wanted in line).split()[-1]

        run = start("run", file)
        folder = last_word(run, "processes, into")
        page = opened(last_word(start("dashboard", folder, "--port", 0), "the dashboard is at"))
        run.kill()
        page.wait_for_selector(
            f"#trouble:has-text('It was cut off; `afspm run --resume {folder}`')", timeout=DEADLINE_S * 1000
        )


def test_the_end_needs_confirmation_and_is_shown(night: Night, opened: Opened, keep: object) -> None:
    page = opened(night.url, person="Ada")
    page.click("button:has-text('End the experiment')")
    page.click(".question button:has-text('End it')")
    page.wait_for_selector(".question:has-text('Really?')")
    page.click(".question:has-text('Really?') button:has-text('Cancel')")
    page.locator(".question:has-text('Really?')").wait_for(state="detached")
    condition = night.follower.overview.processes["series"].condition
    assert condition is not ProcessCondition.ENDED
    assert night.process.poll() is None
    page.click("button:has-text('End the experiment')")
    page.click(".question button:has-text('End it')")
    page.click("button:has-text('Yes, end the experiment')")
    assert night.process.wait(DEADLINE_S) == 0
    page.wait_for_selector("#trouble:has-text('The experiment has ended')")
    assert page.evaluate("document.querySelector('.steer').inert")
    assert callable(keep)
    keep(page, "ended")
