"""The page shows the published data."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from urllib.parse import urljoin

import numpy as np
import pytest
from tests.ui.ui_lab import Night, Opened

import afspm
from afspm.drawing.palette import colour_map
from afspm.drawing.raster import Contrast, indices, value_range
from afspm.model import Region, Scan
from afspm.model.line_levelling import Levelling, levelled

TURNED = Region((0.4e-6, -0.3e-6), (0.8e-6, 0.5e-6), 0.4)


@pytest.fixture(scope="module")
def scan(night: Night) -> Iterator[Scan]:
    """A rotated scan of many pixels, longer than wide: every mirror image of it differs."""
    with afspm.connect(night.folder, "tester") as scope:
        with scope.control():  # a person may have set others before
            scope.set("tip-bias-voltage", "100 mV")
            scope.set("scan-speed", "4 um/s")
            taken = scope.scan(TURNED, shape=(48, 72), timeout_s=60.0).first
        yield taken


def shown(page: Any, scan: Scan) -> Any:
    """Return the canvas, once it shows the scan."""
    page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{scan.time_ns}'")
    return page.locator(".picture")


def drawn(page: Any) -> str:
    """Wait for a picture; return its time."""
    page.wait_for_function("document.querySelector('.picture').dataset.number > 0")
    return str(page.get_attribute(".picture", "data-time"))


def read_value(page: Any, column: int, row: int) -> float:
    """Point at a pixel, and read its value."""
    x, y = page.evaluate(
        f"(() => {{ const g = afspm.image.geometry; return g.toScreen(g.fromPixel([{column}, {row}])) }})()"
    )
    page.locator(".picture").hover(position={"x": x, "y": y})
    page.wait_for_selector(f".readout[data-column='{column}'][data-row='{row}']")
    return float(page.get_attribute(".readout", "data-value"))


@pytest.mark.parametrize(("column", "row"), [(0, 0), (71, 0), (0, 47), (20, 31), (55, 7)])
def test_the_value_under_the_pointer_is_the_one_published(
    night: Night, opened: Opened, scan: Scan, column: int, row: int
) -> None:
    page = opened(night.url)
    shown(page, scan)
    assert read_value(page, column, row) == scan.values[row, column]


def test_the_position_under_the_pointer_is_the_position_of_the_pixel(night: Night, opened: Opened, scan: Scan) -> None:
    page = opened(night.url)
    shown(page, scan)
    read_value(page, 70, 3)
    x, y = (float(axis[3, 70]) * 1e9 for axis in TURNED.pixels_m(scan.shape))
    text = page.inner_text(".readout").replace("−", "-")
    assert f"at ({x:.5g}, {y:.5g}) nm" in text


@pytest.mark.parametrize("levelling", list(Levelling))
def test_each_pixel_has_the_colour_of_its_value(night: Night, opened: Opened, scan: Scan, levelling: Levelling) -> None:
    page = opened(night.url)
    shown(page, scan)
    number = page.get_attribute(".picture", "data-number")
    page.select_option("[data-part=levelling]", levelling.value)
    page.wait_for_function("n => afspm.image.head.levelling === n", arg=levelling.value)
    assert page.get_attribute(".picture", "data-number") == number
    values = levelled(scan.values, levelling)
    wanted = colour_map("gold")[indices(values, value_range(values, Contrast.ROBUST))]
    for column, row in ((3, 20), (68, 4), (5, 44), (40, 20), (66, 42)):  # none under the scale bar
        found = page.evaluate(
            """([column, row]) => {
              const { canvas, geometry } = afspm.image;
              const [x, y] = geometry.toScreen(geometry.fromPixel([column, row])), ratio = window.devicePixelRatio;
              return [...canvas.getContext("2d").getImageData(x * ratio, y * ratio, 1, 1).data].slice(0, 3);
            }""",
            [column, row],
        )
        assert np.abs(np.array(found) - wanted[row, column]).max() <= 1, (column, row)


def test_the_page_is_marked_simulated_and_shows_the_facts_of_a_scan(
    night: Night, opened: Opened, scan: Scan, keep: Any
) -> None:
    page = opened(night.url)
    shown(page, scan)
    assert page.locator(".simulated").inner_text() == "SIMULATED: this is not a real microscope"
    facts = dict(zip(*(page.locator(f".facts {tag}").all_inner_texts() for tag in ("dt", "dd")), strict=True))
    assert (facts["Angle"], facts["Pixels"], facts["Size"]) == ("22.92°", "72 × 48", "800 × 500 nm")
    assert facts["Bias"] == "100 mV"
    assert facts["Tip"] == "at the sample, feedback on"
    assert {"Scan", "Finished", "Took", "Speed", "Setpoint"} <= facts.keys()
    keep(page, "watching")


def test_the_pointer_may_be_the_keyboard(night: Night, opened: Opened, scan: Scan) -> None:
    page = opened(night.url)
    shown(page, scan).focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_selector(".readout[data-column='37'][data-row='24']")
    page.keyboard.press("Shift+ArrowUp")
    page.wait_for_selector(".readout[data-column='37'][data-row='34']")
    assert float(page.get_attribute(".readout", "data-value")) == scan.values[34, 37]
    page.keyboard.press("+")
    assert page.evaluate("afspm.image.view.zoom") == 1.5
    page.keyboard.press("0")
    assert page.evaluate("afspm.image.view.zoom") == 1


def test_zoom_keeps_the_place_under_the_pointer(night: Night, opened: Opened, scan: Scan) -> None:
    page = opened(night.url)
    shown(page, scan)
    before = read_value(page, 60, 40)
    page.mouse.wheel(0, -600)
    page.wait_for_function("afspm.image.view.zoom > 2")
    assert read_value(page, 60, 40) == before
    page.click("[data-zoom='0']")
    page.wait_for_function("afspm.image.view.zoom === 1")


def test_a_profile_is_drawn_along_a_line(night: Night, opened: Opened, scan: Scan, keep: Any) -> None:
    page = opened(night.url)
    shown(page, scan)
    page.select_option("[data-part=levelling]", "none")
    page.wait_for_function("afspm.image.head.levelling === 'none'")
    page.click("[data-tool=profile]")
    box = page.locator(".picture").bounding_box()
    ends = page.evaluate(
        """(() => {
          const g = afspm.image.geometry;
          return [[10, 20], [60, 20]].map((pixel) => g.toScreen(g.fromPixel(pixel)));
        })()"""
    )
    page.mouse.move(box["x"] + ends[0][0], box["y"] + ends[0][1])
    page.mouse.down()
    page.mouse.move(box["x"] + ends[1][0], box["y"] + ends[1][1], steps=4)
    page.mouse.up()
    page.wait_for_function("afspm.image.profile?.distances_m.at(-1) > 0.5e-6")
    values = page.evaluate("afspm.image.profile.values")
    assert len(values) == 51
    assert max(values) <= scan.values[19:22, 10:61].max() + 1e-12
    assert np.corrcoef(values, scan.values[20, 10:61])[0, 1] > 0.99
    keep(page, "profile")


def test_a_scan_is_seen_again_by_a_click_in_the_map(night: Night, opened: Opened, scan: Scan) -> None:
    page = opened(night.url)
    shown(page, scan)
    first = page.locator(".map polygon.scan:not(.shown)").first
    first.wait_for()
    time_ns = first.get_attribute("data-time")
    assert time_ns != str(scan.time_ns)
    first.click(force=True, position={"x": 4, "y": 4})
    page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{time_ns}'")
    page.click("text=Back to the newest scan")
    shown(page, scan)


def test_a_scan_grows_line_by_line(night: Night, opened: Opened, scan: Scan, keep: Any) -> None:
    page = opened(night.url)
    with afspm.connect(night.folder, "grower") as scope, scope.control():
        scope.set("scan-speed", "0.5 um/s")
        page.evaluate(
            """() => {
              window.seen = [];
              new MutationObserver(() => window.seen.push(Number(document.querySelector(".picture").dataset.rows)))
                .observe(document.querySelector(".picture"), { attributeFilter: ["data-number"] });
            }"""
        )
        grown = scope.scan(Region((0, 0), (1e-6, 1e-6)), shape=(32, 32), timeout_s=60.0).first
        page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{grown.time_ns}'")
        scope.set("scan-speed", "4 um/s")
    rows = page.evaluate("window.seen")
    growing = [count for count in rows if count < 32]
    assert len(growing) >= 3
    assert growing == sorted(growing)
    assert rows[-1] == 32


def test_control_processes_log_and_time_line_are_as_published(night: Night, opened: Opened) -> None:
    page = opened(night.url)
    night.until(lambda: len(night.follower.overview.processes) >= 4)
    for name, state in night.follower.overview.processes.items():
        page.wait_for_selector(f"[role=rowheader]:text-is('{name}')")
        assert state.starts >= 1
    page.wait_for_selector("ul.log >> text=the dashboard is at")
    for lane in ("control", "mode", "microscope", "processes"):
        assert page.locator(f".lane > b:text-is('{lane}')").count() == 1
    page.click(".time .q-toggle")
    page.wait_for_selector(".lane > b:text-is('scheduler')")
    page.locator(".lane > b:text-is('processes')").wait_for(state="detached")


def test_the_log_is_filtered(night: Night, opened: Opened) -> None:
    page = opened(night.url)
    page.wait_for_selector("ul.log >> text=the dashboard is at")
    page.fill("input[aria-label=contains]", "no line is like this")
    page.wait_for_selector("text=No such line.")
    page.fill("input[aria-label=contains]", "DASHBOARD is at")
    page.wait_for_selector("ul.log >> text=the dashboard is at")
    assert page.locator("ul.log li").count() == 1


@pytest.mark.parametrize(
    ("width", "height", "theme"), [(390, 844, "light"), (390, 844, "dark"), (1024, 768, "light"), (2000, 1100, "dark")]
)
def test_the_page_fits_any_screen(
    night: Night, opened: Opened, scan: Scan, keep: Any, width: int, height: int, theme: str
) -> None:
    page = opened(night.url, width=width, height=height, theme=theme)
    page.wait_for_selector(".map svg", state="attached")
    page.wait_for_selector("[role=rowheader]", state="attached")
    page.wait_for_function("document.querySelector('.picture').dataset.number > 0")
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    light = sum(int(part) for part in ground.removeprefix("rgb(").rstrip(")").split(",")) > 384
    assert light is (theme == "light")
    keep(page, f"{theme}-{width}")


@pytest.mark.parametrize("person", ["", "Ada"])
def test_time_line_and_log_are_on_the_first_screen(
    night: Night, opened: Opened, scan: Scan, person: str, keep: Any
) -> None:
    page = opened(night.url, person=person, width=1440, height=900)
    drawn(page)
    page.wait_for_selector("ul.log li")
    for part in ("scan", "sample", "time", "log"):
        box = page.locator(f"section.{part}").bounding_box()
        assert box["y"] >= 0
        assert box["y"] + box["height"] <= 900, part
    picture = page.evaluate("(() => { const { width, height } = afspm.image.geometry.box; return [width, height]; })()")
    assert max(picture) > 300
    panel, axis = (page.locator(part).bounding_box() for part in ("section.time", "section.time .lane-axis"))
    assert axis["y"] + axis["height"] <= panel["y"] + panel["height"], "the axis of the time line is seen"
    assert panel["y"] + panel["height"] - axis["y"] - axis["height"] < 70, "the time line fills its panel"
    cut = """[...document.querySelectorAll('.lane b, .process .name, ul.log b')]
        .filter((one) => one.offsetParent && one.scrollWidth > one.clientWidth).map((one) => one.textContent)"""
    assert page.evaluate(cut) == []
    keep(page, f"first-screen-{person or 'nobody'}")


@pytest.mark.parametrize("name", ["scan", "sample", "time", "log"])
def test_a_phone_shows_one_part_at_a_time_below_a_bar_that_stays(
    night: Night, opened: Opened, scan: Scan, name: str, keep: Any
) -> None:
    page = opened(night.url, width=390, height=844)
    drawn(page)
    page.click(f"[role=tab][data-tab={name}]")
    page.locator(f"section.{name}").wait_for(state="visible")
    others = {"scan", "sample", "time", "log"} - {name}
    assert not any(page.locator(f"section.{other}").is_visible() for other in others)
    assert page.evaluate("document.documentElement.scrollHeight") < 1600
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    page.evaluate("window.scrollTo(0, 5000)")
    # in one step: the page may replace a part between finding it and asking for its place
    places = "['[data-part=mode]', '.tabs'].map((one) => document.querySelector(one).getBoundingClientRect().toJSON())"
    bar, tabs = page.evaluate(places)
    assert 0 <= bar["y"] < 150
    assert page.locator("h1").is_visible(), "the name of the experiment"
    assert page.locator("button[aria-label='Light or dark']").is_visible()
    assert page.locator("[data-part=progress]").is_visible(), "5 of 49"
    assert tabs["y"] + tabs["height"] == pytest.approx(844, abs=1)
    keep(page, f"phone-{name}")


# users 11
def test_nothing_moves_below_the_bar_when_a_scan_begins(night: Night, opened: Opened, scan: Scan) -> None:
    page = opened(night.url, width=1280, height=800)
    drawn(page)
    longer = """() => {
      const chips = document.querySelector('.bar .chips'), top = () => document.querySelector('.screen').offsetTop;
      const before = top();
      chips.innerHTML += '<span class=chip>microscope scanning 100 % <small>ends 23:07:23</small></span>';
      return [before, top(), chips.textContent];
    }"""
    before, after, text = page.evaluate(longer)
    assert before == after
    assert " for " in text, "a reader hears two words, not one"


# users 11
def test_a_wide_scan_fills_the_width_of_its_panel(night: Night, opened: Opened, scan: Scan, keep: Any) -> None:
    with afspm.connect(night.folder, "wide") as scope, scope.control():
        taken = scope.scan(Region((0, 0), (2e-6, 0.5e-6)), shape=(16, 64), timeout_s=60.0).first
    page = opened(night.url, width=1280, height=800)
    canvas = shown(page, taken)
    room = page.locator(".stage").bounding_box()
    box, facts = canvas.bounding_box(), page.locator(".stage .facts").bounding_box()
    assert box["width"] == pytest.approx(room["width"], abs=2)
    assert box["y"] + box["height"] <= facts["y"] < facts["y"] + 80 <= room["y"] + room["height"]
    canvas.focus()
    keep(page, "wide-scan")


def test_scans_of_different_sizes_at_one_place_are_pictures_on_the_map(
    night: Night, opened: Opened, scan: Scan, keep: Any
) -> None:
    with afspm.connect(night.folder, "mapper") as scope, scope.control():
        taken = [scope.scan(Region((0, 0), (side, side)), shape=(24, 24), timeout_s=60.0).first
                 for side in (0.9e-6, 0.3e-6)]  # fmt: skip
    page = opened(night.url)
    for one in taken:
        page.wait_for_selector(f".map polygon[data-time='{one.time_ns}']", state="attached")
        picture = page.locator(f".map image[href*='/{one.time_ns}?']")
        assert picture.count() == 1
        answer = page.request.get(urljoin(page.url, picture.get_attribute("href")))
        assert (answer.status, answer.headers["content-type"]) == (200, "image/png")
        assert answer.body().startswith(b"\x89PNG")
    page.wait_for_selector(f".strip img[data-time='{taken[-1].time_ns}']")
    keep(page, "map")


def test_a_scan_is_seen_again_by_a_click_on_the_time_line(night: Night, opened: Opened, scan: Scan) -> None:
    page = opened(night.url)
    newest = drawn(page)
    other = page.locator(f".strip img:not([data-time='{newest}'])").first
    time_ns = other.get_attribute("data-time")
    other.click()
    page.wait_for_function(f"document.querySelector('.picture').dataset.time === '{time_ns}'")


def test_both_axes_of_the_picture_have_one_unit(night: Night, opened: Opened, scan: Scan) -> None:
    with afspm.connect(night.folder, "liner") as scope, scope.control():
        far = scope.scan(Region((2e-6, 0), (0.4e-6, 0.4e-6)), shape=(16, 16), timeout_s=60.0).first
    page = opened(night.url)
    page.evaluate(
        """() => {
          const draw = CanvasRenderingContext2D.prototype.fillText;
          window.texts = [];
          CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
            window.texts.push(text);
            return draw.call(this, text, ...rest);
          };
        }"""
    )
    page.wait_for_selector(f".map polygon[data-time='{far.time_ns}']", state="attached")
    page.evaluate(f"afspm.pin({{ time: '{far.time_ns}', channel: '{far.channel}' }})")
    page.wait_for_function("window.texts?.includes('y / µm') && window.texts.includes('x / µm')")


def test_a_viewer_without_a_name_can_steer_nothing(night: Night, opened: Opened) -> None:
    page = opened(night.url)
    page.wait_for_selector("[role=rowheader]")
    assert page.locator("section.steer").count() == 0
    assert page.locator(".bar button:visible:has-text('Take over')").count() == 0
    assert page.locator(".process button:visible").count() == 0
    assert page.locator("[data-tool=scan]:visible").count() == 0
