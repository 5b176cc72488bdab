"""The page opens with the topography, whatever channel came first, and keeps a channel that a person chose."""

from __future__ import annotations

from typing import Any

from benchmarks.stage import Stage, picture
from tests.ui.ui_lab import Opened

from afspm.model import ChannelRoles


def chosen(page: Any) -> str:
    return str(page.input_value("[data-part=channel]"))


def test_page_opens_with_the_topography_and_keeps_what_a_person_chose(browser: Any, opened: Opened) -> None:
    with Stage() as stage:
        stage.publish(ChannelRoles({"topography": ("Current",)}))
        for channel in ("Height", "Amplitude", "Phase", "Current"):
            stage.scan(picture(32), channel)
        page = opened(stage.url)
        page.wait_for_function("document.querySelector('[data-part=channel]').options.length >= 4")
        assert page.evaluate("document.querySelector('[data-part=channel]').options[0].value") == "Current"
        assert chosen(page) == "Current"
        page.wait_for_function("afspm.image.head?.channel === 'Current'")
        page.select_option("[data-part=channel]", "Phase")
        page.evaluate("afspm.image.setChannels(['Height', 'Phase'])")
        assert chosen(page) == "Phase"
