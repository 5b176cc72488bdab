"""The page on a path of its own behind a proxy, in tabs that nobody sees, and on screens of three widths."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from sub_path_proxy import SubPathProxy
from tests.ui.ui_lab import Night, Opened

HIDE = """hidden => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => hidden });
  document.dispatchEvent(new Event("visibilitychange"));
}"""
SIGN_ABOVE_MODE = """() => {
  const [sign, mode] = [".who", "[data-part=mode]"].map((one) => document.querySelector(one)?.getBoundingClientRect());
  return sign?.height && mode?.height && sign.bottom <= mode.top + 1;
}"""


def test_page_works_on_a_path_of_its_own_behind_a_proxy(night: Night, opened: Opened) -> None:
    with SubPathProxy(night.url) as proxy:
        page = opened(proxy.url)
        page.wait_for_selector(".picture[data-number]")
        page.wait_for_function("afspm.image.bar.naturalHeight > 0")
        page.click("a.sign")
        page.fill("#person", "Ada")
        page.click("button")
        page.wait_for_selector("text=Take over: MANUAL")
        assert page.url == proxy.url
        page.wait_for_selector(".picture[data-number]")
        page.locator(".picture").focus()
        page.keyboard.press("ArrowRight")
        page.wait_for_selector(".readout[data-value]")
        page.click("text=Sign out")
        page.wait_for_selector("#person")
        assert page.url == f"{proxy.url}login"
        assert proxy.outside in ([], ["/favicon.ico"])


def test_hidden_tab_asks_for_no_picture_until_it_is_seen_again(night: Night, opened: Opened) -> None:
    asked: list[str] = []
    page = opened(night.url)
    page.wait_for_selector(".picture[data-number]")
    page.on("request", lambda request: asked.append(request.url))
    page.evaluate(HIDE, True)
    page.evaluate("afspm.image.hear(1e9)")  # news: a tab that is seen would ask for the picture now
    for _ in range(3):  # the page's own socket goes on
        page.evaluate("window.before = afspm.updated")
        page.wait_for_function("afspm.updated > window.before")
    assert not [url for url in asked if "live/image" in url]
    with page.expect_request("**/live/image**"):
        page.evaluate(HIDE, False)


def test_tab_without_the_focus_holds_no_request_open(night: Night, opened: Opened) -> None:
    asked: list[str] = []
    page = opened(night.url)
    page.wait_for_selector(".picture[data-number]")
    with page.expect_event("response", lambda answer: "patient=false" in answer.url and answer.status == 204):
        page.evaluate("document.hasFocus = () => false; window.dispatchEvent(new Event('blur'))")
    page.on("request", lambda request: asked.append(request.url))
    for _ in range(3):
        page.evaluate("window.before = afspm.updated")
        page.wait_for_function("afspm.updated > window.before")
    assert not [url for url in asked if "live/image" in url]
    with page.expect_request("**/live/image**"):
        page.evaluate("afspm.image.hear(1e9)")


@pytest.mark.parametrize("width", [1440, 1024, 390])
def test_nothing_is_cut_or_covered_on_a_screen(
    width: int, night: Night, opened: Opened, keep: Callable[[Any, str], None]
) -> None:
    page = opened(night.url, person="Ada", width=width, height=900)
    page.wait_for_selector(".picture[data-number]")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.evaluate("document.querySelector('[data-part=channel]').replaceChildren(new Option('Height Retrace'))")
    keep(page, f"scan-{width}")
    hint = "[data-part=hint]"
    page.evaluate("afspm.image.choose('look')")
    cut = "one => one.parentElement.scrollWidth > one.parentElement.clientWidth + 1"
    assert not page.locator(hint).evaluate(cut)
    if width < 500:
        page.wait_for_function(SIGN_ABOVE_MODE)
        page.click("[data-tab=steer]")
    field = page.locator(".parameters input").first
    field.fill("50 V")
    field.press("Enter")
    refusal = page.locator(".fields .q-field__bottom:has-text('outside')")
    refusal.wait_for()
    keep(page, f"refused-{width}")
    below = page.locator(".parameters .acts").bounding_box()
    box = refusal.bounding_box()
    assert box["y"] + box["height"] <= below["y"] + 1, "the refusal lies over the buttons"
