"""The page opens with the topography, whatever channel came first, and keeps a channel that a person chose."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.ui.ui_lab import Night, Opened

# of the simulator's channels the current comes last
NAMED = '[microscope.channels]\nheight = "Current"\n'


@pytest.fixture(scope="module")
def renamed(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Night]:
    """A night whose topography is the last channel that comes."""
    folder: Path = tmp_path_factory.mktemp("renamed")
    one = Night(folder, more=NAMED)
    yield one
    one.close()


def chosen(page: Any) -> str:
    return str(page.input_value("[data-part=channel]"))


def test_page_opens_with_the_topography_and_keeps_what_a_person_chose(renamed: Night, opened: Opened) -> None:
    page = opened(renamed.url)
    page.wait_for_function("document.querySelector('[data-part=channel]').options.length >= 4")
    assert page.evaluate("document.querySelector('[data-part=channel]').options[0].value") == "Current"
    assert chosen(page) == "Current"
    page.wait_for_function("afspm.image.head?.channel === 'Current'")
    page.select_option("[data-part=channel]", "Phase")
    page.evaluate("afspm.image.setChannels(['Height', 'Phase'])")
    assert chosen(page) == "Phase"
