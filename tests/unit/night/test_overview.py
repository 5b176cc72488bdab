"""The overview of an experiment, reduced from its packets."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from afspm import model, wire
from afspm.model import (
    ControlEvent,
    ControlMode,
    ControlRequest,
    ControlState,
    ProcessCondition,
    RegistrationOutcome,
    RescanKind,
    ScopeState,
)
from afspm.model.events import NO_LONGER_TRUE, LogLines
from afspm.model.planned_work import PlannedWork
from afspm.night.overview import MOST_LINES, Overview
from afspm.night.reading_curves import MOST_POINTS

S = 1_000_000_000
REGION = model.Region((0.0, 0.0), (1e-6, 1e-6))
TIP = int(model.Problem.TIP_SHAPE_CHANGED)


def status(state: ScopeState) -> model.ScopeStatus:
    return model.ScopeStatus(state)


def control(holder: str | None, *problems: int, mode: ControlMode = ControlMode.AUTOMATED) -> ControlState:
    return ControlState(mode, holder, problems)


def scan(channel: str, time_s: int, rows: int = 4) -> model.Scan:
    return model.Scan(REGION, channel, "m", np.zeros((rows, rows)), time_s * S)


def lines(first_row: int, count: int, began_s: int = 10) -> model.ScanLines:
    return model.ScanLines(REGION, (4, 4), "Height", "m", first_row, np.zeros((count, 4)), began_s * S)


def process(condition: ProcessCondition, since_s: int, starts: int = 1, last_exit: str = "") -> model.ProcessState:
    return model.ProcessState("series", "component", condition, since_s * S, starts=starts, last_exit=last_exit)


def entry(
    time_s: float, what: str, response: int | None = 0, who: str = "classifier", reason: str = "", **codes: Any
) -> object:
    made = model.JournalEntry(round(time_s * S), "request", who, what, response, reason, **codes)
    return model.JournalEntries((made,))


NIGHT: list[tuple[str, object, int]] = [
    ("ScopeStateMsg", status(ScopeState.FREE), 1),
    ("ControlState", control("series"), 2),
    ("ScanParameters2d", model.ScanParameters(REGION, (4, 4)), 3),
    ("ScopeStateMsg", status(ScopeState.SCANNING), 10),
    ("ScanLines", lines(0, 2), 12),
    ("Scan2d", scan("Height", 14), 14),
    ("ScopeStateMsg", status(ScopeState.FREE), 15),
    ("ScopeStateMsg", status(ScopeState.SCANNING), 20),
    ("ScanLines", lines(0, 1, began_s=20), 21),
    ("ControlState", control(None, TIP), 22),
    ("JournalEntries", entry(22, "flags a problem", request=ControlRequest.ADD_EXP_PRBLM, problem=TIP), 23),
    ("ScopeStateMsg", status(ScopeState.INTERRUPTED), 24),
    ("ScopeStateMsg", status(ScopeState.FREE), 25),
    ("ControlState", control("corrector", TIP), 26),
    ("ProcessStates", model.ProcessStates(30 * S, "lab", (process(ProcessCondition.BUSY, 29),)), 30),
    ("JournalEntries", entry(31, "sets scan-speed to 1 m/s", 9, "series", "at most 1e-5 m/s"), 31),
    ("LogLines", LogLines((model.LogLine(32 * S, "series", "WARNING", "the tip is blunt"),)), 32),
    ("ControlState", control("corrector"), 35),
    ("ControlState", control(None, mode=ControlMode.MANUAL), 40),
]


def seen(*packets: tuple[str, object, int]) -> Overview:
    overview = Overview()
    for message, thing, time_s in packets:
        overview.take(message, thing, time_s * S)
    return overview


def test_newest_of_each_state_is_kept() -> None:
    night = seen(*NIGHT)
    assert night.status == status(ScopeState.FREE)
    assert night.control == control(None, mode=ControlMode.MANUAL)
    assert night.readings.scan_parameters == model.ScanParameters(REGION, (4, 4))
    assert night.newest_ns == 40 * S


def test_timeline_of_control_names_its_holders() -> None:
    spans = [(s.label, s.start_ns // S, s.end_ns and s.end_ns // S) for s in seen(*NIGHT).timelines.control.spans]
    assert spans == [("series", 2, 22), ("corrector", 26, 40)]


def test_timeline_of_modes_has_an_open_end() -> None:
    now = seen(*NIGHT).timelines.mode.now
    assert now is not None
    assert (now.label, now.start_ns, now.end_ns) == ("manual", 40 * S, None)


def test_problem_span_names_its_flagger() -> None:
    (span,) = seen(*NIGHT).timelines.problems[TIP].spans
    assert (span.label, span.start_ns, span.end_ns) == ("tip-shape-changed", 22 * S, 35 * S)
    assert span.by == "classifier"


def test_scan_has_its_start_and_its_holder() -> None:
    whole = seen(*NIGHT).scans[0]
    assert (whole.began_ns, whole.time_ns, whole.holder, whole.interrupted) == (10 * S, 14 * S, "series", False)


def test_interrupted_scan_with_lines_is_kept_and_marked() -> None:
    part = seen(*NIGHT).scans[1]
    assert part.interrupted
    assert (part.began_ns, part.time_ns, part.shape, part.holder) == (20 * S, 24 * S, (4, 4), "series")


def test_scan_without_values_has_its_measured_shape() -> None:
    night = Overview()
    night.take("Scan2d", model.Scan(REGION, "Topo", "m", np.empty((0, 0)), 5 * S, pixels=(6, 8)), 6 * S, "Scan2d")
    assert [one.shape for one in night.scans] == [(6, 8)]


def test_each_channel_of_a_scan_has_a_summary() -> None:
    night = Overview()
    night.take("Scan2d", scan("Height", 5), 6 * S, "Scan2d_1000.0_Height")
    night.take("Scan2d", scan("Phase", 5), 7 * S, "Scan2d_1000.0_Phase")
    assert [one.channel for one in night.scans] == ["Height", "Phase"]


def test_repeated_packets_do_not_change_the_overview() -> None:
    once, twice = seen(*NIGHT), seen(*NIGHT, *NIGHT)
    for _ in range(2):
        for message, thing, time_s in NIGHT[::3]:
            twice.take(message, thing, time_s * S)
    assert facts(twice) == facts(once)


def facts(night: Overview) -> list[object]:
    lanes = [
        night.timelines.control,
        night.timelines.mode,
        night.timelines.scope_state,
        *night.timelines.problems.values(),
        *night.process_history.timelines.values(),
    ]
    told = [night.scans, night.spectra, night.drift, list(night.log), list(night.entries), list(night.refusals)]
    return [*told, night.control, night.status, night.processes, [list(lane.spans) for lane in lanes]]


def test_refusal_is_kept_with_its_reason() -> None:
    (refused,) = seen(*NIGHT).refusals
    assert (refused.who, refused.reason) == ("series", "at most 1e-5 m/s")


def test_log_is_bounded() -> None:
    night = Overview()
    for k in range(3):
        batch = tuple(model.LogLine(i, "series", "INFO", f"{k} {i}") for i in range(MOST_LINES))
        night.take("LogLines", LogLines(batch), k + 1)
    assert len(night.log) == MOST_LINES
    assert night.log[-1].text == f"2 {MOST_LINES - 1}"


def test_busy_counts_as_alive_in_the_timeline_only() -> None:
    night = seen(
        ("ProcessStates", model.ProcessStates(S, "lab", (process(ProcessCondition.ALIVE, 1),)), 1),
        ("ProcessStates", model.ProcessStates(S, "lab", (process(ProcessCondition.BUSY, 3),)), 3),
    )
    assert [span.label for span in night.process_history.timelines["series"].spans] == ["alive"]
    assert night.processes["series"].condition is ProcessCondition.BUSY


def test_restart_is_listed_once_with_its_last_exit() -> None:
    again = process(ProcessCondition.ALIVE, 5, 2, "killed")
    night = seen(
        ("ProcessStates", model.ProcessStates(S, "lab", (process(ProcessCondition.ALIVE, 1),)), 1),
        ("ProcessStates", model.ProcessStates(5 * S, "lab", (again,)), 5),
        ("ProcessStates", model.ProcessStates(7 * S, "lab", (again,)), 7),
    )
    assert [(one.name, one.starts, one.last_exit) for one in night.process_history.restarts] == [
        ("series", 2, "killed")
    ]


def test_progress_of_a_running_scan_follows_its_lines() -> None:
    night = seen(*NIGHT[:5])
    assert night.running is not None
    assert night.running.rows == (2, 4)
    assert night.scan_progress(12 * S) == (0.5, 2 * S)


def test_progress_of_a_scan_without_lines_follows_earlier_scans() -> None:
    without_lines = [one for one in NIGHT[:8] if one[0] != "ScanLines"]
    assert seen(*without_lines[:4]).scan_progress(12 * S) is None
    assert seen(*without_lines).scan_progress(22 * S) == (0.4, 3 * S)  # the one before took 5 s


def test_scan_found_running_after_lost_contact_has_no_start_and_predicts_no_other() -> None:
    states = (ScopeState.FREE, ScopeState.FREE, ScopeState.UNDEFINED, ScopeState.SCANNING)
    packets: list[tuple[str, object, int]] = [
        ("ScopeStateMsg", status(state), time_s) for time_s, state in zip((1, 10, 30, 70), states, strict=True)
    ]
    overview = seen(*packets, ("Scan2d", scan("Height", 70), 71), ("ScopeStateMsg", status(ScopeState.FREE), 72))
    assert [one.began_ns for one in overview.scans] == [None]
    overview.take("ScopeStateMsg", status(ScopeState.SCANNING), 80 * S)
    assert overview.scan_progress(81 * S) is None, "a scan of 2 s would be predicted"


def test_progress_ignores_scans_of_other_pixels() -> None:
    wide = ("ScanParameters2d", model.ScanParameters(REGION, (400, 400)), 16)
    without_lines = [*NIGHT[:4], *NIGHT[5:7], wide, NIGHT[7]]
    assert seen(*without_lines).scan_progress(22 * S) is None


def test_running_scan_is_none_after_its_end() -> None:
    assert seen(*NIGHT).running is None


def test_drift_is_the_displacement_of_the_sample() -> None:
    message: Any = wire.message_type("DriftMapping")(
        matrix=[1, 0, -2e-9, 0, 1, 3e-9], center=[0, 0], rate=[1e-12, 0], matched=True, lost=False
    )
    message.timestamp.FromNanoseconds(5 * S)
    night = Overview()
    night.take("DriftMapping", message, 6 * S)
    (point,) = night.drift
    assert point.time_ns == 5 * S
    assert point.translation_m == pytest.approx((2e-9, -3e-9))
    assert point.rate_m_s == (1e-12, 0.0)


def mapping(at_s: int, outcome: RegistrationOutcome, failures: int = 0) -> Any:
    message: Any = wire.message_type("DriftMapping")(
        matrix=[1, 0, 0, 0, 1, 0], center=[0, 0], covariance=[9e-18, 0, 0, 25e-18], matched=outcome.is_registered,
        outcome=int(outcome), failures=failures, reason="oh", filename=f"{at_s}.nc",
    )  # fmt: skip
    message.timestamp.FromNanoseconds(at_s * S)
    return message


def test_drift_point_has_outcome_and_uncertainty() -> None:
    night = Overview()
    outcomes = (RegistrationOutcome.REGISTERED, RegistrationOutcome.COARSE, RegistrationOutcome.FAILED)
    for number, outcome in enumerate(outcomes):
        night.take("DriftMapping", mapping(number, outcome, failures=number), (number + 1) * S)
    assert [point.outcome for point in night.drift] == list(outcomes)
    assert [(point.sd_m, point.failures, point.filename) for point in night.drift][2] == (
        pytest.approx(5e-9), 2, "2.nc",
    )  # fmt: skip
    assert night.registration == "registered 2 of 3 scans, 1 of them coarsely, 1 failed"


def opposite(at_s: int, kind: RescanKind = RescanKind.OPPOSITE) -> Any:
    message: Any = wire.message_type("DriftRescan")(kind=int(kind))
    message.timestamp.FromNanoseconds(at_s * S)
    return message


def test_thermal_drift_before_the_first_scan_in_both_directions_is_routine() -> None:
    drift = int(model.Problem.THERMAL_DRIFT)
    night = seen(
        ("ControlState", control("series"), 1),
        ("ControlState", control("rescanner", drift), 10),
        ("DriftRescan", opposite(10), 11),
        ("ControlState", control("series"), 20),
        ("ControlState", control("rescanner", drift), 50),
        ("DriftRescan", opposite(50, RescanKind.SEARCH), 51),
    )
    assert [(span.start_ns, span.end_ns) for span in night.routine_spans] == [(10 * S, 20 * S)]
    assert [span.start_ns for span in night.problem_spans] == [50 * S]


def test_spectrum_summary_has_its_position() -> None:
    curve = model.Spectrum((1e-9, 2e-9), "IV", ("V", "I"), ("V", "A"), np.zeros((3, 2)), 4 * S)
    (told,) = seen(("ControlState", control("grid"), 1), ("Spec1d", curve, 5)).spectra
    assert (told.time_ns, told.position_m, told.kind, told.holder) == (4 * S, (1e-9, 2e-9), "IV", "grid")


def test_newest_message_without_a_declaration_is_kept() -> None:
    night = seen(("Own", 1, 1), ("Own", 2, 3))
    assert night.announced == {"Own": (3 * S, 2)}


def test_progress_is_the_newest_of_each_component() -> None:
    night = Overview()
    for name, done, time_s in (("series", 3, 1), ("grid", 1, 2), ("series", 4, 3)):
        night.take("Progress", model.Progress(time_s * S, name, done, 9), time_s * S, f"Progress_{name}")
    reports = {name: (report.done, report.of) for name, report in night.progress_reports.items()}
    assert reports == {"series": (4, 9), "grid": (1, 9)}


def test_remaining_time_falls_between_packets() -> None:
    told = model.Progress(20 * S, "series", 2, 10, left_s=40.0)
    assert told.remaining_ns(25 * S) == 35 * S
    assert told.remaining_ns(500 * S) == 0
    assert model.Progress(20 * S, "series", 2, 10).remaining_ns(20 * S) is None


def change(time_s: int, who: str, event: ControlEvent, **codes: Any) -> tuple[str, object, int]:
    entry = model.JournalEntry(time_s * S, "control", who, "in words", event=event, **codes)
    return "JournalEntries", model.JournalEntries((entry,)), time_s


STORY: list[tuple[str, Any, int]] = [
    change(2, "series", ControlEvent.CONTROL_GAINED),
    change(22, "classifier", ControlEvent.PROBLEM_FLAGGED, problem=TIP),
    change(23, "series", ControlEvent.CONTROL_LOST),
    change(26, "corrector", ControlEvent.CONTROL_GAINED, problem=TIP),
    change(35, "corrector", ControlEvent.PROBLEM_CLEARED, problem=TIP),
    change(36, "corrector", ControlEvent.CONTROL_LOST),
    change(40, "terminal:ada", ControlEvent.MODE_CHANGED, mode=ControlMode.MANUAL),
]


def test_late_joiner_gets_the_past_from_the_journal() -> None:
    late = seen(*STORY, ("ControlState", control(None, mode=ControlMode.MANUAL), 41))
    assert [(s.label, s.start_ns // S) for s in late.timelines.control.spans] == [("series", 2), ("corrector", 26)]
    assert (late.in_control, late.control_since_ns) == ("ada", 40 * S)
    (flagged,) = late.timelines.problems[TIP].spans
    assert (flagged.by, flagged.start_ns, flagged.end_ns) == ("classifier", 22 * S, 35 * S)
    assert late.timelines.mode.now is not None
    assert late.timelines.mode.now.start_ns == 40 * S


def test_journal_of_known_changes_adds_nothing() -> None:
    states = [one for one in NIGHT if one[0] == "ControlState"]
    with_journal = seen(
        *states,
        (
            "JournalEntries",
            model.JournalEntries(
                tuple(  # a batch comes a moment later
                    entry for _, batch, _ in STORY for entry in batch.entries
                )
            ),
            41,
        ),
    )
    assert [list(seen(*states).timelines.control.spans)] == [list(with_journal.timelines.control.spans)]


def test_summaries_of_a_scan_share_equal_parts() -> None:
    # a page that is open for weeks keeps a hundred thousand; each packet brings its own objects
    overview = Overview()
    for number, channel in enumerate(("Height", "Phase", "Height_Retrace")):
        message, payload = wire.encode(model.Scan(REGION, channel, "m", np.zeros((4, 4)), 14 * S, "scan-0001.nc"))
        overview.take(message, wire.decode(message, payload), 14 * S + number, f"Scan2d_{channel}")
    first, *others = overview.scans
    assert len(others) == 2
    for other in others:
        assert other.region is first.region
        assert (other.filename is first.filename, other.unit is first.unit, other.time_ns is first.time_ns) == (
            True,
        ) * 3


def test_readings_of_instruments_become_bounded_curves() -> None:
    overview = Overview()
    for i in range(20_000):
        value = None if i == 19_000 else float(i)
        reading = model.InstrumentReading("cryo.t", value, "K", 0.1, reason="" if value else "no sensor")
        overview.take("InstrumentReadings", model.InstrumentReadings(i * S, "cryo", (reading,)), i * S)
    curve = overview.instruments["cryo.t"]
    assert curve.unit == "K"
    assert 1000 < len(curve.times_ns) == len(curve.values) <= MOST_POINTS
    assert (curve.times_ns[0], curve.times_ns[-1]) == (0, 19_999 * S)
    assert sum(math.isnan(value) for value in curve.values) == 1


def logged(time_s: int, name: str, level: str, text: str) -> tuple[str, object, int]:
    return "LogLines", LogLines((model.LogLine(time_s * S, name, level, text),)), time_s


def test_alarm_is_open_until_a_line_of_its_process_ends_it() -> None:
    full = "nothing can be recorded, the experiment goes on: No space left on device"
    over = f"there is room on the disk again; {NO_LONGER_TRUE}nothing can be recorded"
    packets = [
        logged(1, "recorder", "CRITICAL", full),
        logged(2, "recorder", "CRITICAL", "  Traceback (most recent call last):"),
        logged(3, "recorder", "CRITICAL", full),
        logged(4, "scheduler", "CRITICAL", full),
        logged(5, "recorder", "INFO", "scan 3 is recorded"),
        logged(6, "recorder", "INFO", f"{NO_LONGER_TRUE}nothing can be"),
    ]
    assert [(one.name, one.time_ns // S) for one in seen(*packets).open_alarms] == [("recorder", 1), ("scheduler", 4)]
    night = seen(*packets, logged(7, "recorder", "INFO", over))
    assert [one.name for one in night.open_alarms] == ["scheduler"]
    assert [one.ended_ns for one in night.alarms] == [7 * S, None]
    night = seen(*packets, logged(7, "recorder", "INFO", over), logged(8, "recorder", "CRITICAL", full))
    assert [(one.name, one.time_ns // S) for one in night.open_alarms] == [("scheduler", 4), ("recorder", 8)]


def test_time_in_manual_does_not_count_as_progress_of_a_component() -> None:
    overview = Overview()
    overview.take("ControlState", control("series"), 1 * S)
    overview.take("Progress", model.Progress(10 * S, "series", 1, 5, left_s=100.0), 10 * S)
    overview.take("ControlState", control(None, mode=ControlMode.MANUAL), 30 * S)
    left = {now_s: overview.progress_at(now_s * S)["series"].remaining_ns(now_s * S) for now_s in (20, 30, 500)}
    assert left == {20: 90 * S, 30: 80 * S, 500: 80 * S}
    overview.take("ControlState", control(None), 600 * S)
    assert overview.progress_at(610 * S)["series"].remaining_ns(610 * S) == 70 * S


def test_time_in_manual_puts_off_the_planned_end_before_the_first_report() -> None:
    overview, plans = Overview(), {"series": PlannedWork(duration_s=1000.0, ends_experiment=True)}
    overview.take("ControlState", control(None, mode=ControlMode.MANUAL), 10 * S)
    overview.take("ControlState", control("series"), 310 * S)
    assert overview.expected_end_ns(plans, 0, 400 * S) == 1300 * S
