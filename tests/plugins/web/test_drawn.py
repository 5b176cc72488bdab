"""Map, time line, curves and texts in the HTML."""

from __future__ import annotations

import json
import re
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from datetime import UTC
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from afspm import wire
from afspm.basics import ExperimentClock, time_of_day, typeset_position, zone_offset_s
from afspm.components import PlannedWork
from afspm.drawing import timeline_html
from afspm.model import (
    ControlMode,
    ControlState,
    Frame,
    JournalEntry,
    LogLine,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Progress,
    Region,
    RegistrationOutcome,
    ScopeState,
    ScopeStatus,
    Spectrum,
)
from afspm.night import DriftPoint, Overview, ScanSummary, SpectrumSummary
from afspm.plugins.web.dashboard.charts import drift_chart, spectrum_chart
from afspm.plugins.web.dashboard.content import refusals_html, rows_of, status_html, unheard
from afspm.plugins.web.dashboard.panels import log_html, process_words
from afspm.plugins.web.dashboard.sample_map import MapContent, map_html, places_of
from afspm.plugins.web.watch import Watch

S = 1_000_000_000
HERE = Region((0.0, 0.0), (1e-6, 1e-6))


def taken(time_s: float, region: Region = HERE, channel: str = "Height", **more: Any) -> ScanSummary:
    return ScanSummary(round(time_s * S), None, channel, "m", region, (8, 8), holder="series", **more)


def svg(html: str) -> ElementTree.Element:
    return ElementTree.fromstring(re.search(r"<svg.*?</svg>", html, re.DOTALL).group())  # type: ignore[union-attr]


def shapes(html: str, style: str) -> list[ElementTree.Element]:
    return [shape for shape in svg(html) if style in (shape.get("class") or "").split()]


def time_line_html(overview: Overview, now_ns: int, silent: Mapping[str, int] = MappingProxyType({})) -> str:
    return timeline_html(rows_of(overview, silent), None, now_ns)


def corners(shape: ElementTree.Element) -> np.ndarray:
    return np.array([point.split(",") for point in (shape.get("points") or "").split()], dtype=float)


# --- the map ---


def test_scans_lie_at_their_places_rotated_and_with_y_upwards() -> None:
    high = Region((3e-6, 4e-6), (2e-6, 1e-6), 0.5)
    html = map_html(MapContent([taken(1), taken(2, high)]))
    drawn = {shape.get("data-time"): corners(shape) for shape in shapes(html, "scan")}
    low_px, high_px = drawn[str(S)], drawn[str(2 * S)]
    per_m = (high_px.mean(axis=0)[0] - low_px.mean(axis=0)[0]) / 3e-6
    assert per_m > 0
    assert (high_px.mean(axis=0)[1] - low_px.mean(axis=0)[1]) / -4e-6 == pytest.approx(per_m, rel=1e-3)
    wanted = (high.corners_m() - np.array(high.center_m)) * per_m * np.array([1, -1])
    assert np.allclose(high_px - high_px.mean(axis=0), wanted, atol=0.1)


def test_a_scan_on_the_map_carries_its_time_and_channel() -> None:
    (shape,) = shapes(map_html(MapContent([taken(7, channel='A "B"')])), "scan")
    assert (shape.get("data-time"), shape.get("data-channel")) == (str(7 * S), 'A "B"')


def test_scans_of_one_place_are_one_on_the_map_the_newest() -> None:
    places, left_out = places_of([taken(i, channel=c) for i in range(1, 50) for c in ("Height", "Phase")])
    assert left_out == 0
    ((newest, count),) = places
    assert (newest.time_ns, count) == (49 * S, 49)


@pytest.mark.parametrize("center_m", [(0.0, 0.0), (1e-6, -2e-6)])
def test_squares_of_different_sizes_at_one_place_are_all_on_the_map(center_m: tuple[float, float]) -> None:
    sizes_m = [2e-6, 400e-9, 390e-9, 1e-6]
    scans = [taken(i, Region(center_m, (size_m, size_m))) for i, size_m in enumerate(sizes_m, 1)]
    drawn = {shape.get("data-time") for shape in shapes(map_html(MapContent(scans)), "scan")}
    assert drawn == {str(i * S) for i in range(1, 5)}


def test_pictures_lie_at_the_places_of_their_scans_the_newest_on_top() -> None:
    wide, narrow = Region((0.0, 0.0), (2e-6, 2e-6)), Region((4e-7, 2e-7), (5e-7, 2.5e-7), 0.3)
    html = map_html(MapContent([taken(1, narrow), taken(2, wide, 'A "B"')], pictures="/p"))
    pictures = [shape for shape in svg(html) if shape.tag == "image"]
    assert [shape.get("href") for shape in pictures] == [f"/p/{S}?channel=Height", f"/p/{2 * S}?channel=A%20%22B%22"]
    outline = corners(next(shape for shape in shapes(html, "scan") if shape.get("data-time") == str(S)))
    x, y, width, height = (float(pictures[0].get(name) or 0.0) for name in ("x", "y", "width", "height"))
    assert (x + width / 2, y + height / 2) == pytest.approx(outline.mean(axis=0), abs=0.02)
    sides = np.hypot(*np.diff(outline, axis=0).T)
    assert sorted((width, height)) == pytest.approx(sorted(sides[:2]), abs=0.05)
    assert (pictures[0].get("transform") or "").startswith("rotate(-17.189 ")
    assert not [shape for shape in svg(map_html(MapContent([taken(1)]))) if shape.tag == "image"]


def test_a_small_scan_below_a_newer_large_one_can_still_be_clicked() -> None:
    small, large = Region((0.0, 0.0), (3e-7, 3e-7)), Region((0.0, 0.0), (2e-6, 2e-6))
    drawn = shapes(map_html(MapContent([taken(1, small), taken(2, large)])), "scan")
    assert [shape.get("data-time") for shape in drawn] == [str(2 * S), str(S)], "the last one is on top"


@pytest.mark.parametrize(
    ("probe_m", "side", "distance"), [((5e-6, 0.0), "left:100.00%", "4.4 µm"), ((0.0, -3e-6), "top:100.00%", "2.4 µm")]
)
def test_a_probe_outside_the_view_is_shown_by_an_arrow_with_its_distance(
    probe_m: tuple[float, float], side: str, distance: str
) -> None:
    html = map_html(MapContent([taken(1)], probe_m=probe_m), whole=False)
    (arrow,) = re.findall(r'<span class="map-away"(.*?)</span>', html)
    assert side in arrow
    assert f"probe {distance} away" in arrow
    assert "map-away" not in map_html(MapContent([taken(1)], probe_m=(1e-7, 0.0)), whole=False)


def test_targets_of_a_component_are_on_the_map() -> None:
    overview = Overview()
    message: Any = wire.message_type("SpatialPointWithScoreList")(channel="Height")
    for x_nm, score in ((100.0, 0.5), (-200.0, 0.9)):
        entry = message.spatials.add(score=score)
        entry.spatial.point.x, entry.spatial.units = x_nm, "nm"
    message.spatials.add().spatial.units = "parsnips"
    overview.take("SpatialPointWithScoreList", message, S)
    assert [target.xy_m for target in overview.targets] == [(1e-7, 0.0), (-2e-7, 0.0)]
    drawn = shapes(map_html(MapContent([taken(1)], targets=overview.targets)), "target")
    assert ["score 0.5" in "".join(shape.itertext()) for shape in drawn] == [True, False]


def test_ten_thousand_places_are_drawn_up_to_a_bound_and_the_rest_counted() -> None:
    scans = [taken(i, Region((i * 1e-6, 0.0), (1e-6, 1e-6))) for i in range(10_000)]
    html = map_html(MapContent(scans))
    assert "8500 older places are left out" in html
    assert len(shapes(html, "scan")) == 1500


def test_region_limits_probe_and_spectra_are_on_the_map() -> None:
    spectrum = SpectrumSummary(5 * S, "IV", (1e-7, 2e-7), Frame.TIP, ("V",), ("V",))
    limits = Region((0.0, 0.0), (20e-6, 20e-6))
    html = map_html(MapContent([taken(1)], [spectrum], HERE.moved_to((1e-6, 0.0)), limits, probe_m=(0.0, 0.0)))
    assert [len(shapes(html, style)) for style in ("current", "limits", "spectrum", "probe")] == [1, 1, 1, 1]
    assert shapes(html, "spectrum")[0].get("data-spectrum") == str(5 * S)


def test_the_measured_area_fills_the_map_unless_all_limits_are_shown() -> None:
    content = MapContent([taken(1)], limits=Region((0.0, 0.0), (1e-3, 1e-3)))
    near, whole = (np.ptp(corners(shapes(map_html(content, whole=w), "scan")[0]), axis=0).max() for w in (False, True))
    assert near > 600
    assert whole < 2


def test_the_limits_move_over_a_drifting_sample() -> None:
    mapping = np.array([[1.0, 0.0, -2e-6], [0.0, 1.0, 0.0]])
    content = MapContent([taken(1)], limits=Region((0.0, 0.0), (4e-6, 4e-6)), tip_to_sample=mapping)
    html = map_html(content)
    limits, scan = corners(shapes(html, "limits")[0]), corners(shapes(html, "scan")[0])
    assert (limits.mean(axis=0)[0] - scan.mean(axis=0)[0]) / np.ptp(limits[:, 0]) == pytest.approx(-0.5, abs=1e-3)
    assert "the sample has moved by (2, 0)" in html.replace("-0", "0")


def test_an_interrupted_scan_is_marked() -> None:
    assert shapes(map_html(MapContent([taken(1, interrupted=True)])), "cut")


def test_an_empty_map_says_so() -> None:
    assert "No scan or spectrum yet" in map_html(MapContent())


# --- the time line ---


def test_the_time_line_has_control_mode_state_problems_and_processes() -> None:
    overview = Overview()
    overview.take("ControlState", ControlState(ControlMode.AUTOMATED, "series"), S)
    overview.take("ScopeStateMsg", ScopeStatus(ScopeState.SCANNING), 2 * S)
    overview.take("ControlState", ControlState(ControlMode.AUTOMATED, None, (1,)), 3 * S)
    html = time_line_html(overview, 10 * S)
    for part in ("series", "automated", "scanning", "tip-shape-changed"):
        assert part in html


def test_processes_are_one_row_of_the_time_line_until_one_fails() -> None:
    overview = Overview()

    def told(time_s: int, condition: ProcessCondition) -> None:
        states = tuple(
            ProcessState(name, "component", condition if name == "series" else ProcessCondition.ALIVE, time_s * S)
            for name in ("scheduler", "series", "metadata")
        )
        overview.take("ProcessStates", ProcessStates(time_s * S, "here", states), time_s * S)

    def rows(**how: bool) -> list[str]:
        return [row.name for row in rows_of(overview, {}, **how)][3:]

    told(1, ProcessCondition.ALIVE)
    assert rows(unfolded=False) == ["processes"]
    assert rows(unfolded=True) == ["scheduler", "series", "metadata"]
    told(2, ProcessCondition.STARTING)
    told(3, ProcessCondition.ALIVE)
    assert rows(unfolded=False) == ["series", "processes"]


def test_scans_are_pictures_on_the_time_line_the_last_of_overlapping_ones_shown() -> None:
    lane = Overview()
    lane.take("ScopeStateMsg", ScopeStatus(ScopeState.FREE), S)
    html = timeline_html(rows_of(lane, {}), 0, 1400 * S, pictures=[(t * S, f"<img {t}>") for t in (10, 20, 700, 2000)])
    assert re.findall(r"left:([\d.]+)%;[^>]*><img (\d+)>", html) == [("0.00", "20"), ("50.00", "700")]


def test_names_from_outside_are_text_and_never_html() -> None:
    overview = Overview()
    evil = '<img src=x onerror="alert(1)">'
    overview.take("ControlState", ControlState(ControlMode.AUTOMATED, evil), S)
    overview.take("ScopeStateMsg", ScopeStatus(ScopeState.FREE), 2 * S)
    line = LogLine(S, evil, "INFO", evil)
    entry = JournalEntry(S, "request", evil, evil, 1, evil)
    spectrum = Spectrum((0.0, 0.0), evil, (evil, evil), ("V", evil), np.ones((3, 2)), S)
    for html in (
        time_line_html(overview, 9 * S), log_html([line], frozenset(), "INFO"), refusals_html([entry]),
        map_html(MapContent([taken(1, channel=evil)])), spectrum_chart([(S, spectrum)], "").words,
    ):  # fmt: skip
        assert "<img" not in html
        assert "&lt;img" in html


# --- lists ---


def test_the_log_is_filtered_by_component_level_and_text_newest_first() -> None:
    lines = [
        LogLine(1 * S, "series", "INFO", "scan 1"),
        LogLine(2 * S, "series", "WARNING", "slow"),
        LogLine(3 * S, "tip", "ERROR", "Scan lost"),
        LogLine(4 * S, "tip", "DEBUG", "scan detail"),
    ]

    def texts(*arguments: object) -> list[str]:
        return re.findall(r"<span>(.*?)</span>", log_html(lines, *arguments))  # type: ignore[arg-type]

    assert texts(frozenset(), "INFO") == ["Scan lost", "slow", "scan 1"]
    assert texts(frozenset({"series"}), "INFO") == ["slow", "scan 1"]
    assert texts(frozenset(), "WARNING") == ["Scan lost", "slow"]
    assert texts(frozenset(), "DEBUG", "SCAN") == ["scan detail", "Scan lost", "scan 1"]
    assert texts(frozenset({"nobody"}), "INFO") == []


def test_a_long_log_is_shown_to_a_bounded_length() -> None:
    lines = [LogLine(i, "a", "INFO", str(i)) for i in range(2000)]
    html = log_html(lines, frozenset(), "INFO")
    assert html.count("<li") == 300
    assert "<span>1999</span>" in html


def test_refusals_have_client_request_and_reason() -> None:
    html = refusals_html([JournalEntry(S, "request", "dashboard:Ada", "set bias to 9 V", 9, "above max = 6 V")])
    assert "dashboard:Ada" in html
    assert "set bias to 9 V" in html
    assert "above max = 6 V" in html


def test_a_process_is_described_in_words() -> None:
    busy = ProcessState("series", "component", ProcessCondition.BUSY, S, 12.4, 3, 7, "killed: frozen")
    condition, since, restarts = process_words(busy)
    assert (condition, since, restarts) == (
        "busy",
        "in the same step for 12 s",
        "restarted 2 times (last: killed: frozen)",
    )
    fine = ProcessState("series", "component", ProcessCondition.ALIVE, S)
    assert process_words(fine)[2] == ""


ELSEWHERE = 600


def gone() -> Overview:
    """Two computers; one of them sends no reports from 30 s on."""
    overview = Overview()
    for time_s in range(1, ELSEWHERE, 2):
        for name, computer in (("scheduler", "here"), ("series", "there")):
            if computer == "there" and time_s > 30:
                continue
            state = ProcessState(name, "component", ProcessCondition.ALIVE, S)
            done = ProcessState(f"done_{computer}", "component", ProcessCondition.ENDED, S)
            told = ProcessStates(time_s * S, computer, (state, done))
            overview.take("ProcessStates", told, time_s * S, f"ProcessStates_{computer}")
    return overview


def test_processes_of_a_lost_computer_are_not_shown_as_alive() -> None:
    watch = Watch(ExperimentClock.real(), past=gone())
    silent = unheard(watch, watch.overview)
    assert silent == {"series": (ELSEWHERE - 1 - 29) * S}, "and what has ended there has ended"
    state = watch.overview.processes["series"]
    assert process_words(state, silent["series"])[:2] == (
        "no report", "for 9 min 30 s: its supervisor has ended or can't be reached",
    )  # fmt: skip
    html = time_line_html(watch.overview, ELSEWHERE * S, silent)
    assert html.count("process-no-report") == 1
    assert "process-no-report" not in time_line_html(gone(), ELSEWHERE * S)


def test_a_faster_simulated_night_makes_no_process_count_as_gone() -> None:
    watch = Watch(ExperimentClock.starting_now(speed=600.0), past=gone())
    assert unheard(watch, watch.overview) == {}


def test_page_shows_the_end_of_each_component_and_of_the_experiment() -> None:
    clock = ExperimentClock.starting_now(1_700_000_000.0, 1e-6)  # stands still, near enough
    began_ns = clock.now_ns() - 100 * S
    plans = {"series": PlannedWork(scans=4, duration_s=1000.0, ends_experiment=True), "grid": None}
    watch = Watch(clock, plans=plans, began_ns=began_ns)
    watch.take("ControlState", ControlState(ControlMode.AUTOMATED, "series"), clock.now_ns())
    before = status_html(watch, watch.overview)
    assert re.search(r'data-part="end">ends about \d\d:\d\d <small>15 min', before), before
    watch.take("Progress", Progress(clock.now_ns(), "series", 1, 4, 2 * 86_400.0), clock.now_ns(), "Progress_series")
    html = status_html(watch, watch.overview)
    assert "<b>series</b> 1 of 4</span>" in html, "the end of the experiment stands beside it"
    assert re.search(r'data-part="end">ends about \d{4}-\d\d-\d\d \d\d:\d\d <small>2 d', html), html
    alone = status_html(Watch(clock, past=watch.overview), watch.overview)
    assert 'data-part="end"' not in alone
    assert re.search(r"<b>series</b> 1 of 4 <small>ends \d{4}-\d\d-\d\d \d\d:\d\d</small>", alone), alone


# --- curves ---


def lines(options: Any) -> list[list[list[float | None]]]:
    """Return the points of each line of a chart, as the browser gets them."""
    return [one["data"] for one in json.loads(json.dumps(options, allow_nan=False))["series"] if one["type"] == "line"]


def test_drift_is_drawn_against_time_with_its_state_in_words() -> None:
    points = [DriftPoint(i * S, (i * 1e-9, -i * 1e-9), (1e-9, 0.0), correcting=True) for i in range(10)]
    chart = drift_chart(points)
    x, y = lines(chart.options)
    assert x[-1] == [9000.0 + 1e3 * zone_offset_s(9 * S), 9.0]
    assert y[-1] == [9000.0 + 1e3 * zone_offset_s(9 * S), -9.0]
    assert "corrected" in chart.words
    lost = drift_chart([*points, DriftPoint(11 * S, (0.0, 0.0), (0.0, 0.0), lost=True, reason="no overlap")])
    assert "The sample is lost: no overlap" in lost.words
    assert lines(lost.options)[0][-1] == [11000.0 + 1e3 * zone_offset_s(9 * S), None], "a gap, and no line to zero"


def test_predicted_positions_are_drawn_as_dots() -> None:
    points = [DriftPoint(i * S, (1e-9, 2e-9), (0.0, 0.0), matched=i % 2 == 0) for i in range(4)]
    options = drift_chart(points).options
    assert options is not None
    (dots,) = [one for one in options["series"] if one["type"] == "scatter"]
    assert len(dots["data"]) == 4


def test_the_page_says_how_many_scans_were_registered_and_that_the_last_is_dead_reckoning() -> None:
    points = [DriftPoint(i * S, (1e-9, 2e-9), (0.0, 0.0)) for i in range(3)]
    assert "Registered 3 of 3 scans." in drift_chart(points).words
    failed = DriftPoint(
        4 * S, (1e-9, 2e-9), (0.0, 0.0), matched=False, reason="<oh>", outcome=RegistrationOutcome.FAILED, sd_m=30e-9
    )
    words = drift_chart([*points, failed]).words
    assert "The last scan is predicted (standard deviation 30 nm): &lt;oh&gt;" in words
    assert "Registered 3 of 4 scans, 1 failed." in words


def test_missing_drift_is_stated() -> None:
    chart = drift_chart([])
    assert "does not track drift" in chart.words
    assert chart.options is None


def test_a_spectrum_is_drawn_with_those_before_it_behind() -> None:
    values = np.stack([np.linspace(-1, 1, 50), np.linspace(0, 1e-9, 50)], axis=1)
    spectra = [(i * S, Spectrum((0.0, 0.0), "IV", ("V", "I"), ("V", "A"), values, i * S)) for i in range(1, 4)]
    chart = spectrum_chart(spectra, "I")
    named = [(S, Spectrum(None, "force", ("ZSnsr", "Defl"), ("m", "m"), np.ones((3, 2)), S))]
    axes = spectrum_chart(named, "Defl").options or {}
    assert (axes["xAxis"]["name"], axes["yAxis"]["name"]) == ("ZSnsr (height) / m", "Defl (deflection) / m")
    assert chart.options is not None
    assert len(lines(chart.options)) == 3
    assert [one["lineStyle"].get("opacity") for one in chart.options["series"]] == [0.4, 0.4, 1.0]
    assert chart.options["yAxis"]["name"] == "I / nA"
    assert "Tip: &lt;away&gt;" in spectrum_chart(spectra, "I", [("Tip", "<away>")]).words


def test_a_spectrum_of_one_variable_is_no_error() -> None:
    spectrum = Spectrum(None, "", ("V",), ("V",), np.ones((3, 1)), S)
    assert "no curve" in spectrum_chart([(S, spectrum)], "I").words


@pytest.mark.parametrize("gone", [np.nan, np.inf])
def test_values_that_are_not_finite_are_gaps_in_a_spectrum(gone: float) -> None:
    values = np.array([[0.0, 1.0], [1.0, gone], [gone, 2.0], [3.0, 3.0]])
    chart = spectrum_chart([(S, Spectrum(None, "IV", ("V", "I"), ("", ""), values, S))], "I")
    assert [point[1] for point in lines(chart.options)[0]] == [1.0, None, None, 3.0]


def test_positions_read_well() -> None:
    assert typeset_position((1.2e-6, -5e-7)) == "(1.2, −0.5) µm"
    assert typeset_position((0.0, 0.0)) == "(0, 0) nm"


def test_times_of_the_drift_have_the_zone_of_the_page_not_of_the_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    if not hasattr(time, "tzset"):
        pytest.skip("this system has one zone")
    monkeypatch.setenv("TZ", "XYZ-5:30")
    time.tzset()
    try:
        options = drift_chart([DriftPoint(10 * S, (0.0, 0.0), (0.0, 0.0))]).options
        shown = time_of_day(10 * S)
    finally:
        monkeypatch.undo()
        time.tzset()
    assert options is not None
    assert options["useUTC"] is True
    ((at_ms, _),) = options["series"][0]["data"]
    assert time_of_day(round(at_ms) * 1_000_000, UTC) == shown == "05:30:10"
