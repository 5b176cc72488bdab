"""Facts beside a scan: its number, times, and parameters."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from afspm.basics import ExperimentClock
from afspm.model import (
    HEIGHT_RETRACE,
    ActByHand,
    ChannelRoles,
    ControlMode,
    ControlState,
    Feedback,
    MeasurementConditions,
    PanelAct,
    Region,
    Scan,
    ScanLines,
    ScopeState,
    ScopeStatus,
    TipStatus,
)
from afspm.night import Overview
from afspm.plugins.web.dashboard.actions import ActionResult
from afspm.plugins.web.dashboard.conditions import Conditions
from afspm.plugins.web.dashboard.pictures import SIDE_PX, Thumbnails
from afspm.plugins.web.dashboard.scan_facts import scan_facts
from afspm.plugins.web.frames import ChannelFrame
from afspm.plugins.web.watch import Watch

S = 1_000_000_000
REGION = Region((1e-6, -5e-7), (1e-6, 5e-7), 0.1)
VALUES = np.arange(8.0).reshape(2, 4)


def states(*changes: tuple[ScopeState, int]) -> list[tuple[str, Any, int]]:
    return [("ScopeStateMsg", ScopeStatus(state), time_s * S) for state, time_s in changes]


def a_scan(begin_s: int, channels: Sequence[str] = ("Height", "Phase")) -> list[tuple[str, Any, int]]:
    end_s = begin_s + 10
    scans = [
        ("Scan2d", Scan(REGION, channel, "m", VALUES, time_ns=end_s * S), end_s * S + i)
        for i, channel in enumerate(channels)
    ]
    return [*states((ScopeState.FREE, begin_s - 1), (ScopeState.SCANNING, begin_s)), *scans,
            *states((ScopeState.FREE, end_s + 1))]  # fmt: skip


def overview_of(packets: Sequence[tuple[str, Any, int]]) -> Overview:
    overview = Overview()
    overview.take("ControlState", ControlState(ControlMode.AUTOMATED, "series"), 0)
    for packet in packets:
        overview.take(*packet, f"{packet[0]}_{getattr(packet[1], 'channel', '')}")
    return overview


def test_channels_of_one_scan_share_one_number() -> None:
    overview = overview_of([*a_scan(10), *a_scan(40), *a_scan(70)])
    assert [one.number for one in overview.scans] == [1, 1, 2, 2, 3, 3]


def test_a_finished_scan_has_number_time_holder_place_and_parameters() -> None:
    overview = overview_of([*a_scan(10), *a_scan(40)])
    frame = ChannelFrame(1, "Height", "m", REGION, VALUES, 50 * S, None, 2)
    facts = dict(scan_facts(frame, overview, {"Bias": "100 mV"}, 60 * S, ChannelRoles()))
    assert {name: facts[name] for name in ("Scan", "Took", "By", "Size", "Centre", "Angle", "Pixels", "Bias")} == {
        "Scan": "no. 2", "Took": "10 s", "By": "series", "Size": "1 × 0.5 µm", "Centre": "(1, −0.5) µm",
        "Angle": "5.73°", "Pixels": "4 × 2", "Bias": "100 mV",
    }  # fmt: skip


@pytest.mark.parametrize("newest_row", [None, 40])
def test_unrest_of_z_leaves_out_slope_and_steps(newest_row: int | None) -> None:
    # results C40
    random = np.random.default_rng(4)
    y, x = np.mgrid[:64, :128] * 1e-9
    values = 0.1 * x - 0.2 * y + 3e-10 * (x > 50e-9) + 20e-12 * random.standard_normal((64, 128))
    values += 50e-12 * random.standard_normal((64, 1))
    if newest_row is not None:
        values[:newest_row] = np.nan  # a scan from the top down
    frame = ChannelFrame(1, "Height", "m", REGION, values, 50 * S if newest_row is None else None, 2, 64, newest_row)
    text = dict(scan_facts(frame, overview_of([]), {}, 60 * S, ChannelRoles()))["Unrest of z"]
    points_pm, lines_pm = (float(part.split()[0]) for part in text.split(", ")[:2])
    assert points_pm == pytest.approx(20.0, rel=0.1)
    assert lines_pm == pytest.approx(50.0, rel=0.5)  # of two dozen lines
    assert text.endswith("(all lines, with the surface)" if newest_row is None else "(last 24 lines, with the surface)")


@pytest.mark.parametrize(("unit", "values"), [("V", np.ones((32, 32))), ("m", np.ones((32, 32))), ("m", VALUES)])
def test_unrest_of_z_is_left_out_where_it_means_nothing(unit: str, values: np.ndarray) -> None:
    frame = ChannelFrame(1, "Height", unit, REGION, values, 50 * S, None, 2)
    assert "Unrest of z" not in dict(scan_facts(frame, overview_of([]), {}, 60 * S, ChannelRoles()))


def test_channel_is_named_and_a_retrace_is_called_one() -> None:
    roles = ChannelRoles({HEIGHT_RETRACE: ("ZB", "Height Retrace")})
    shown = []
    for channel in ("Height", "ZB", "Height Retrace"):
        frame = ChannelFrame(1, channel, "m", REGION, VALUES, 50 * S, None, 2)
        shown.append(dict(scan_facts(frame, overview_of([]), {}, 60 * S, roles))["Channel"])
    assert shown == ["Height", "ZB, retrace", "Height Retrace"]


def test_a_scan_before_the_page_s_start_has_its_recorded_setpoint() -> None:
    feedback = [("ZCtrlParameters", Feedback(setpoint=value), time_s * S) for value, time_s in ((0.7, 5), (0.5, 45))]
    overview = overview_of(sorted([*a_scan(10), *a_scan(40), *a_scan(70), *feedback], key=lambda packet: packet[2]))
    frames = [ChannelFrame(1, "Height", "m", REGION, VALUES, time_s * S, None, 2) for time_s in (50, 80)]
    facts = [dict(scan_facts(frame, overview, {}, 90 * S, ChannelRoles())) for frame in frames]
    assert [one["Setpoint"] for one in facts] == ["0.7", "0.5"]
    read = {"Setpoint": "700 mV"}
    assert dict(scan_facts(frames[0], overview, read, 90 * S, ChannelRoles()))["Setpoint"] == "700 mV"


def test_scan_has_its_tip_at_both_ends_and_the_acts_at_the_microscope_meanwhile() -> None:
    here, away = TipStatus(engaged=True, feedback_on=True), TipStatus(engaged=False, feedback_on=False)
    act = ActByHand(45 * S, PanelAct.WITHDRAW, "seen")
    told = [
        ("MeasurementConditions", MeasurementConditions(20 * S, "", here, here), 20 * S),
        ("ActByHand", act, 45 * S),
        ("MeasurementConditions", MeasurementConditions(50 * S, "", here, away, (act,)), 50 * S),
    ]
    overview = overview_of(sorted([*a_scan(10), *a_scan(40), *told], key=lambda packet: packet[2]))
    good, bad = (
        scan_facts(
            ChannelFrame(1, "Height", "m", REGION, VALUES, at_s * S, None, 2), overview, {}, 60 * S, ChannelRoles()
        )
        for at_s in (20, 50)
    )
    assert dict(good)["Tip"] == "at the sample, feedback on"
    assert "By hand" not in dict(good)
    assert dict(bad)["Tip"] == "at the sample, feedback on → withdrawn, feedback off"
    assert dict(bad)["By hand"] == "the tip was withdrawn at the microscope (seen)"


def test_interrupted_scan_has_the_acts_of_its_time_alone() -> None:
    acts = [("ActByHand", ActByHand(at_s * S, PanelAct.STOP, f"at {at_s}"), at_s * S) for at_s in (30, 45, 70)]
    ended = states((ScopeState.SCANNING, 40), (ScopeState.INTERRUPTED, 50))
    lines = ScanLines(REGION, (2, 4), "Height", "m", 0, VALUES[:1], began_ns=40 * S)
    packets = [*a_scan(10), *acts, *ended, ("ScanLines", lines, 44 * S)]
    overview = overview_of(sorted(packets, key=lambda packet: packet[2]))
    frame = ChannelFrame(1, "Height", "m", REGION, VALUES, None, 40 * S, 1, 0)
    facts = [text for label, text in scan_facts(frame, overview, {}, 80 * S, ChannelRoles()) if label == "By hand"]
    assert facts == ["the measurement was stopped at the microscope (at 45)"]


def test_a_growing_scan_has_its_expected_end() -> None:
    overview = overview_of([*a_scan(10), *states((ScopeState.SCANNING, 40))])
    frame = ChannelFrame(1, "Height", "m", REGION, VALUES, None, 40 * S, 1, 0)
    facts = dict(scan_facts(frame, overview, {}, 44 * S, ChannelRoles()))
    assert facts["Scan"] == "no. 2"
    assert facts["Lines"] == "1 of 2"
    assert facts["Ends"].endswith("(in 7 s)")


def test_conditions_are_read_when_a_scan_begins_and_belong_to_it_alone() -> None:
    asked: list[Future[ActionResult]] = []

    def ask(_: object) -> Future[ActionResult]:
        asked.append(Future())
        return asked[-1]

    watch = Watch(ExperimentClock.real())
    conditions = Conditions(watch, ask)
    for packet in states(
        (ScopeState.FREE, 1), (ScopeState.SCANNING, 2), (ScopeState.FREE, 3), (ScopeState.SCANNING, 4)
    ):
        watch.take(*packet)
    assert len(asked) == 1, "one question at a time"
    bias, speed = ActionResult("100 mV"), ActionResult("no such parameter", ok=False)
    asked[0].set_result(ActionResult("", each={"tip-bias-voltage": bias, "scan-speed": speed}))
    assert conditions.at(2 * S) == {"Bias": "100 mV"}
    assert conditions.at(4 * S) == {}


def test_a_thumbnail_is_small_and_a_scan_no_longer_kept_has_none() -> None:
    values = np.add.outer(np.arange(300.0), np.arange(900.0)) * 1e-12 + 1.0
    values[100:140, 300:400] += 1e-9
    frame = ChannelFrame(1, "Height", "m", REGION, values, S, None, 300)
    thumbnails = Thumbnails(lambda time_ns, channel: frame if (time_ns, channel) == (S, "Height") else None)
    png = thumbnails.png(S, "Height")
    assert png is not None
    assert 100 <= min(int.from_bytes(png[16:20]), int.from_bytes(png[20:24])) <= SIDE_PX
    assert len(png) > 500, "a particle is on it"
    assert thumbnails.png(2 * S, "Height") is None
