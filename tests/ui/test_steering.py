"""Each button has its effect, in the name of the person, as the scheduler's own messages show."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from tests.ui.ui_lab import Night, Opened

import afspm
from afspm.model import ControlMode, ControlRequest, ControlResponse, ProcessCondition, ScopeState, names

ADA = "dashboard:Ada"


@pytest.fixture
def page(night: Night, opened: Opened) -> Iterator[Any]:
    """The page of a person who has signed in, in AUTOMATED mode."""
    page = opened(night.url, person="Ada")
    page.wait_for_selector("button:has-text('Take over')")
    yield page
    if page.locator("button:has-text('Hand back')").is_visible():
        page.click("button:has-text('Hand back')")
    night.until(lambda: night.control().mode is ControlMode.AUTOMATED)


def press(page: Any, text: str) -> None:
    page.get_by_role("button", name=text, exact=True).click()


def take_over(page: Any, night: Night) -> None:
    press(page, "Take over: MANUAL")
    night.until(lambda: night.control().mode is ControlMode.MANUAL)
    page.wait_for_selector("button:visible:has-text('Scan as set')")


def seen(night: Night) -> int:
    """Return the number of journal entries, to look only for later ones."""
    night.follower.pump(0.0)
    return len(night.follower.overview.entries)


def said(page: Any, text: str) -> None:
    """Wait until the page contains a text."""
    page.wait_for_selector(f".outcomes >> text={text}")


def choose(page: Any, label: str, option: str) -> None:
    page.click(f".q-field:visible:has(input[aria-label='{label}'])")
    page.click(f".q-menu .q-item:text-is('{option}'), .q-menu .q-item:has(:text-is('{option}'))")


def field(page: Any, parameter: str) -> Any:
    return page.locator(f".parameters input[aria-label='{parameter}']")


def read(page: Any, parameter: str) -> str:
    return str(field(page, parameter).input_value())


def fill(page: Any, parameter: str, value: str) -> None:
    field(page, parameter).fill(value)


def set_speed(page: Any, value: str, shown: str) -> None:
    fill(page, "scan-speed", value)
    press(page, "Set")
    said(page, f"scan-speed is now {shown}")


def test_a_person_takes_over_and_hands_back(night: Night, page: Any, keep: Any) -> None:
    after = seen(night)
    take_over(page, night)
    assert night.control().holder is None
    assert night.entry(ADA, "MANUAL", after=after).response == 0
    page.wait_for_selector("[data-part=mode]:text-is('MANUAL')")
    keep(page, "manual")
    press(page, "Hand back: AUTOMATED")
    night.until(lambda: night.control().mode is ControlMode.AUTOMATED)
    page.wait_for_selector("[data-part=mode]:text-is('AUTOMATED')")


def test_a_value_left_in_manual_is_kept_or_left_to_the_plan(night: Night, page: Any, keep: Any) -> None:
    take_over(page, night)
    set_speed(page, "3 um/s", "3 µm/s")
    page.wait_for_selector("text=series sets scan-speed 4 µm/s again (you left 3 µm/s)")
    keep(page, "left_in_manual")
    press(page, "Keep mine")
    page.wait_for_selector("text=series measures at scan-speed 3 µm/s, set by dashboard:Ada; it states 4 µm/s")
    keep(page, "not_as_planned")
    press(page, "As planned")
    page.wait_for_selector("text=series sets scan-speed 4 µm/s again")
    set_speed(page, "4 um/s", "4 µm/s")
    page.locator("[data-part=setting]").wait_for(state="detached")


def test_a_problem_is_raised_and_cleared(night: Night, page: Any) -> None:
    choose(page, "problem", "drop-on-the-table")
    press(page, "Flag")
    night.until(lambda: 9 in night.control().problems)
    page.wait_for_selector(".flag:has-text('drop-on-the-table'):has-text('flagged by dashboard:Ada')")
    page.wait_for_selector(".flag .advice:has-text('then clear it')")
    page.wait_for_selector(".lane > b:text-is('drop-on-the-table')")
    press(page, "Clear drop-on-the-table")
    night.until(lambda: 9 not in night.control().problems)
    page.locator("[data-part=problem]").wait_for(state="detached")


def test_all_problems_are_cleared_with_one_button(night: Night, page: Any) -> None:
    for problem, number in (("drop-on-the-table", 9), ("thermal-drift", 4)):
        choose(page, "problem", problem)
        press(page, "Flag")
        night.until(lambda number=number: number in night.control().problems)  # type: ignore[misc]
    press(page, "Clear all problems")
    night.until(lambda: not night.control().problems)
    page.wait_for_selector("[data-part=problem]", state="detached")


def test_parameters_are_read_and_set_and_refusals_give_their_reason(night: Night, page: Any, keep: Any) -> None:
    take_over(page, night)
    assert read(page, "scan-speed") == "4 µm/s"
    fill(page, "tip-bias-voltage", "1250 mV")
    fill(page, "scan-speed", "3 um/s")
    press(page, "Set")
    said(page, "tip-bias-voltage is now 1.25 V")
    said(page, "scan-speed is now 3 µm/s")
    after = seen(night)
    fill(page, "tip-bias-voltage", "7 V")
    fill(page, "scan-speed", "4 um/s")
    press(page, "Set")
    page.wait_for_selector(".outcomes .refused")
    refusal = night.entry(ADA, "tip-bias-voltage = 7", after=after)
    assert refusal.refused
    assert "tip-bias-voltage" in page.inner_text(".outcomes")
    assert "above the highest allowed, 3 V" in refusal.reason
    page.wait_for_selector(".refusals >> text=tip-bias-voltage = 7 V")
    page.wait_for_selector(".q-field--error:has-text('above the highest allowed')")
    assert read(page, "scan-speed") == "4 µm/s", "what was not refused is set"
    keep(page, "refused")


def test_the_microscope_refuses_a_missing_ability(night: Night, page: Any) -> None:
    take_over(page, night)
    after = seen(night)
    fill(page, "scan-size-x", "0 m")
    press(page, "Set")
    page.wait_for_selector(".outcomes .refused")
    assert "Refused" in page.inner_text(".outcomes")
    assert night.entry(ADA, "scan-size-x = 0", after=after).refused


def test_adjustable_parameters_are_set_while_a_component_measures(night: Night, page: Any, keep: Any) -> None:
    field(page, "zctrl-setpoint").wait_for()
    assert page.locator(".parameters input").count() == 2
    number, unit = read(page, "zctrl-setpoint").split()
    with afspm.connect(night.folder, "holder") as scope, scope.control():
        scope.set("scan-speed", "50 nm/s")
        scope.action(names.START_SCAN)
        night.until(lambda: night.state is ScopeState.SCANNING)
        after = seen(night)
        fill(page, "zctrl-setpoint", f"{0.9 * float(number):g} {unit}")
        press(page, "Set")
        said(page, "zctrl-setpoint is now")
        assert not night.entry(ADA, "zctrl-setpoint", after=after).refused
        assert night.control().holder == "holder"
        keep(page, "adjusted")
        assert night.state is ScopeState.SCANNING, "the scan goes on"
        scope.action(names.STOP_SCAN)
        scope.set("scan-speed", "4 um/s")


def test_parameters_follow_other_persons_and_keep_unsent_edits(night: Night, page: Any, opened: Opened) -> None:
    take_over(page, night)
    before = read(page, "tip-bias-voltage")
    fill(page, "scan-size-x", "700 n")
    other = opened(night.url, person="Max")
    for value, shown in (("0.5 V", "500 mV"), (before, before)):
        fill(other, "tip-bias-voltage", value)
        press(other, "Set")
        said(other, f"tip-bias-voltage is now {shown}")
        field_value = "document.querySelector('.parameters input[aria-label=tip-bias-voltage]').value"
        page.wait_for_function(f"{field_value} === '{shown}'")
    assert read(page, "scan-size-x") == "700 n"


def test_a_number_without_its_unit_is_not_sent(night: Night, page: Any) -> None:
    take_over(page, night)
    after = seen(night)
    fill(page, "scan-speed", "8")
    fill(page, "tip-bias-voltage", "1 V")
    press(page, "Set")
    said(page, "Nothing was set. Refused: scan-speed.")
    page.wait_for_selector(".q-field--error:has-text('write the unit as well')")
    assert read(page, "tip-bias-voltage") == "1 V", "the clear value stays in its field, to be sent with the next Set"
    seen(night)
    entries = list(night.follower.overview.entries)[after:]
    asked = [one for one in entries if one.request == ControlRequest.PARAM and one.value]
    assert not [one for one in asked if one.who == ADA]


def test_a_scan_is_taken_where_a_rectangle_is_drawn(night: Night, page: Any, keep: Any) -> None:
    take_over(page, night)
    page.wait_for_function("document.querySelector('.picture').dataset.number > 0")
    page.click("[data-tool=scan]")
    box = page.locator(".picture").bounding_box()
    corners = page.evaluate(
        """(() => {
          const g = afspm.image.geometry;
          return [[-0.3e-6, 0.1e-6], [0.1e-6, -0.2e-6]].map((place) => g.toScreen(place));
        })()"""
    )
    centre = page.evaluate("afspm.image.geometry.place([-0.1e-6, -0.05e-6])")
    page.mouse.move(box["x"] + corners[0][0], box["y"] + corners[0][1])
    page.mouse.down()
    page.mouse.move(box["x"] + corners[1][0], box["y"] + corners[1][1], steps=3)
    page.mouse.up()
    page.wait_for_selector(".question")
    assert page.locator(".question input[aria-label=width]").input_value().startswith("40")
    assert page.evaluate("afspm.image.wanted.width") == pytest.approx(0.4e-6, rel=0.05), "it is drawn while it is asked"
    page.fill(".question input[aria-label=angle]", "30 deg")
    page.wait_for_function("Math.abs(afspm.image.wanted.angle - Math.PI / 6) < 1e-3")
    keep(page, "scan-here")
    page.fill(".question input[aria-label=angle]", "0 deg")
    page.wait_for_function("afspm.image.wanted.angle === 0")
    before = len(night.follower.overview.scans)
    page.click(".question button:has-text('Scan')")
    said(page, "begins")
    night.until(lambda: len(night.follower.overview.scans) > before)
    region = night.follower.overview.scans[-1].region
    assert region.size_m == pytest.approx((0.4e-6, 0.3e-6), rel=0.05)
    assert region.center_m == pytest.approx(centre, abs=1e-8)
    assert page.evaluate("afspm.image.wanted") is None
    assert night.follower.overview.scans[-1].holder is None


def test_the_size_and_pixels_of_a_scan_are_edited_before_it_is_taken(night: Night, page: Any) -> None:
    take_over(page, night)
    page.wait_for_function("document.querySelector('.picture').dataset.number > 0")
    page.click("[data-tool=scan]")
    box = page.locator(".picture").bounding_box()
    page.mouse.click(box["x"] + 150, box["y"] + 120)
    page.fill(".question input[aria-label=width]", "700 nm")
    page.fill(".question input[aria-label=height]", "8")
    page.wait_for_selector(".question:has-text('has no unit')")
    page.click(".question button:has-text('Scan')")
    assert page.locator(".question").is_visible(), "a length without its unit is not scanned"
    page.fill(".question input[aria-label=height]", "350 nm")
    page.click(".question .q-checkbox")
    page.fill(".question input[aria-label=pixels]", "24")
    page.wait_for_selector(".question:has-text('24 × 24 px')")
    before = len(night.follower.overview.scans)
    page.click(".question button:has-text('Scan')")
    night.until(lambda: len(night.follower.overview.scans) > before)
    taken = night.follower.overview.scans[-1]
    assert taken.region.size_m == pytest.approx((7e-7, 7e-7), rel=1e-3)
    assert taken.shape == (24, 24)


def test_a_browser_closed_during_a_dialog_leaves_no_error(night: Night, page: Any, opened: Opened) -> None:
    before = night.errors()
    other = opened(night.url, person="Max")
    other.wait_for_selector("button[aria-label='Restart series']")
    other.click("button[aria-label='Restart series']")
    other.wait_for_selector(".question")
    other.context.close()
    page.wait_for_timeout(12_000)  # the page of a browser that is gone is kept for 10 s
    assert night.errors() == before


def test_a_spectrum_is_taken_by_a_click_and_shown(night: Night, page: Any, keep: Any) -> None:
    take_over(page, night)
    page.wait_for_function("document.querySelector('.picture').dataset.number > 0")
    page.click("[data-tool=spectrum]")
    at = page.evaluate("afspm.image.geometry.toScreen([0, 0])")
    centre = page.evaluate("afspm.image.geometry.place([0, 0])")
    before = len(night.follower.overview.spectra)
    page.click(".picture", position={"x": at[0], "y": at[1]})
    page.click(".question button:has-text('Take it')")
    said(page, "begins")
    night.until(lambda: len(night.follower.overview.spectra) > before)
    taken = night.follower.overview.spectra[-1]
    assert taken.position_m == pytest.approx(centre, abs=2e-9)
    page.wait_for_selector(".spectra .chart path[stroke='var(--t0)']")
    page.wait_for_selector(".map path.spectrum", state="attached")
    keep(page, "spectrum")


def test_a_scan_is_stopped_after_taking_over(night: Night, page: Any) -> None:
    take_over(page, night)
    set_speed(page, "50 nm/s", "50 nm/s")
    press(page, "Scan as set")
    night.until(lambda: night.state is ScopeState.SCANNING)
    press(page, "Stop the scan")
    said(page, "The scan is stopped")
    night.until(lambda: night.state is ScopeState.FREE)
    assert any(span.label == "interrupted" for span in night.follower.overview.timelines.scope_state.spans)
    set_speed(page, "4 um/s", "4 µm/s")


def test_a_scan_requested_twice_does_not_delay_its_stop(night: Night, page: Any) -> None:
    take_over(page, night)
    set_speed(page, "10 nm/s", "10 nm/s")
    press(page, "Scan as set")
    night.until(lambda: night.state is ScopeState.SCANNING)
    press(page, "Scan as set")
    press(page, "Stop the scan")
    said(page, "The scan is stopped")
    night.until(lambda: night.state is ScopeState.FREE)
    set_speed(page, "4 um/s", "4 µm/s")


def test_stopping_in_automated_announces_the_takeover(night: Night, page: Any) -> None:
    press(page, "Stop the scan")
    page.wait_for_selector(".question:has-text('sets the mode to MANUAL')")
    page.keyboard.press("Escape")
    page.locator(".question").wait_for(state="detached")
    assert night.control().mode is ControlMode.AUTOMATED


def test_a_component_is_restarted(night: Night, page: Any) -> None:
    before = night.until(lambda: night.follower.overview.processes.get("series")).starts
    page.click("button[aria-label='Restart series']")
    page.click(".question button:has-text('Restart')")
    said(page, "series is being restarted")
    state = night.until(
        lambda: (
            (s := night.follower.overview.processes["series"]).starts > before
            and s.condition in (ProcessCondition.ALIVE, ProcessCondition.BUSY)
            and s
        )
    )
    assert state.starts == before + 1
    page.wait_for_selector(".process:has-text('series'):has-text('restarted')")
    assert night.entry(ADA, "series").response == ControlResponse.SUCCESS


def test_everything_can_be_done_by_keyboard(night: Night, page: Any) -> None:
    page.locator("button:has-text('Take over')").focus()
    page.keyboard.press("Enter")
    night.until(lambda: night.control().mode is ControlMode.MANUAL)
    page.wait_for_selector("[data-tool=scan]:visible")
    page.locator("[data-tool=scan]").focus()
    page.keyboard.press("Space")
    page.locator(".picture").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    page.wait_for_selector(".question")
    page.keyboard.press("Escape")
    page.locator(".question").wait_for(state="detached")
    assert night.control().mode is ControlMode.MANUAL


def test_two_persons_act_under_their_own_names(night: Night, page: Any, opened: Opened) -> None:
    after = seen(night)
    other = opened(night.url, person="Žofie Ö")
    choose(other, "problem", "drop-on-the-table")
    press(other, "Flag")
    night.until(lambda: 9 in night.control().problems)
    assert night.entry("dashboard:Žofie Ö", "drop-on-the-table", after=after).response == 0
    press(page, "Clear drop-on-the-table")
    night.until(lambda: 9 not in night.control().problems)
    assert night.entry(ADA, "drop-on-the-table", after=after).response == 0
