"""A real browser: Debian's chromium, driven by Playwright. Without it these tests are skipped."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.ui.ui_lab import DEADLINE_S, FOR_ALL, PUMP, SCREENSHOTS, Night, Opened

sys.path.insert(0, str(Path(__file__).parents[2]))  # `benchmarks` has a stage to publish on, which serves here too


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run only the smoke test together with other tests: all of these take minutes, and run with `make test-ui`."""
    here = Path(__file__).parent
    if not any((config.invocation_params.dir / arg.partition("::")[0]).is_relative_to(here) for arg in config.args):
        later = [item for item in items if item.path.is_relative_to(here) and item.path.name != "test_smoke.py"]
        config.hook.pytest_deselected(items=later)
        items[:] = [item for item in items if item not in later]


@pytest.fixture(scope="session")
def night(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Night]:
    """A running experiment, one for all tests of a process: each test leaves it as it was.

    It starts after the browser: without a browser no experiment is started. Its series takes one scan and no other: the
    next one would come between the scans of the tests.
    """
    folder = tmp_path_factory.mktemp("night")
    (folder / "pump.py").write_text(PUMP, encoding="utf-8")
    one = Night(folder, more=FOR_ALL, every="4000 h")
    yield one
    one.close()


@pytest.fixture
def opened(browser: Any, request: pytest.FixtureRequest) -> Iterator[Opened]:
    """`opened(night.url, person="Ada")`: the page in a window of its own; an error in the page fails the test."""
    contexts = []
    wrong: list[str] = []

    def open_(url: str, person: str = "", width: int = 1500, height: int = 1000, theme: str = "light") -> Any:
        context = browser.new_context(
            viewport={"width": width, "height": height}, color_scheme=theme, has_touch=width < 500
        )
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(DEADLINE_S * 1000)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda asked: _only_ours(asked.url, url, wrong))
        if person:
            page.goto(f"{url}/login")
            page.fill("#person", person)
            page.click("button")
        else:
            page.goto(url)
        page.wait_for_selector("text=is in control")
        return page

    yield open_
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    for context in contexts:
        context.close()
    assert not wrong


def _only_ours(asked: str, url: str, wrong: list[str]) -> None:
    if not asked.startswith((url, url.replace("http", "ws", 1), "data:", "blob:")):
        wrong.append(f"asked for {asked}")


@pytest.fixture
def keep() -> Callable[[Any, str], None]:
    """Keep a screenshot in build/screenshots."""

    def screenshot(page: Any, name: str) -> None:
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=SCREENSHOTS / f"{name}.png", full_page=True)

    return screenshot
