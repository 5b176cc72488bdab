"""The report's table of changed parameters, from requests and published feedback of a record."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from afspm import wire
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    JournalEntries,
    JournalEntry,
    Packet,
    ScanParameters,
    names,
)
from afspm.night.run import open_run
from afspm.record.store import RecordSettings, RecordStore
from afspm.report import parameters
from afspm.report.night_report import write

S = 1_000_000_000
START = 1_700_000_000 * S
ADA = "dashboard:Ada"


def request(at_s: float, who: str, kind: ControlRequest, subject: str = "", value: str = "", unit: str = "",
            response: int = 0) -> tuple[float, object]:  # fmt: skip
    at_ns = START + round(at_s * S)
    entry = JournalEntry(
        at_ns, "request", who, "x", response, request=int(kind), sent_ns=at_ns - S // 2, subject=subject, value=value,
        unit=unit,
    )  # fmt: skip
    return at_s, JournalEntries((entry,))


def sets(at_s: float, who: str, name: str, value: str, unit: str = "", response: int = 0) -> tuple[float, object]:
    return request(at_s, who, ControlRequest.PARAM, name, value, unit, response)


def recorded(folder: Path, *packets: tuple[float, object], speed: float = 1.0) -> Path:
    clock = {"origin_s": 0.0, "start_s": START / S, "speed": speed}
    (folder / "run.json").write_text(json.dumps({"clock": clock}), encoding="utf-8")
    store = RecordStore(folder, RecordSettings({"experiment": "bias"}))
    store.take([(Packet(*wire.encode(thing), START + round(at_s * S)), "") for at_s, thing in packets])
    store.flush()
    store.close()
    return folder


def changes(folder: Path) -> list[tuple[float, str, str, str, str]]:
    with open_run(folder) as run:
        found = parameters.read(run)
    return [((one.time_ns - START) / S, one.who, one.parameter, one.before, one.after) for one in found]


def test_requested_parameters_are_changes_from_the_value_requested_before(tmp_path: Path) -> None:
    bias, refused = names.TIP_BIAS_VOLTAGE, int(ControlResponse.PARAM_ERROR)
    folder = recorded(
        tmp_path,
        sets(10, "series", bias, "100", "mV"),
        sets(20, "series", bias, "0.1"),
        sets(30, ADA, bias, "99", "V", refused),
        sets(40, ADA, bias, "-0.5", "V"),
        sets(50, "series", names.SPEC_KIND, "IV"),
        request(60, "series", ControlRequest.PARAM, bias),
    )
    assert changes(folder) == [
        (10.0, "series", bias, "", "100 mV"),
        (40.0, ADA, bias, "100 mV", "-500 mV"),
        (50.0, "series", names.SPEC_KIND, "", "IV"),
    ]


def test_value_after_an_unanswered_request_is_unknown(tmp_path: Path) -> None:
    bias = names.TIP_BIAS_VOLTAGE
    folder = recorded(
        tmp_path,
        sets(10, "series", bias, "1", "V"),
        sets(20, "series", bias, "2", "V", int(ControlResponse.NO_RESPONSE)),
        sets(30, "series", bias, "3", "V"),
    )
    assert changes(folder)[1:] == [(30.0, "series", bias, "", "3 V")]


def test_frame_and_position_are_no_changes(tmp_path: Path) -> None:
    folder = recorded(
        tmp_path,
        sets(10, "series", names.SCAN_SIZE_X, "1e-6"),
        sets(20, "series", names.PROBE_POS_X, "1e-6"),
        request(30, "series", ControlRequest.SET_SCAN_PARAMS),
        (31, ScanParameters(shape=(64, 64))),
    )
    assert changes(folder) == []
    assert "Parameters changed" not in write(folder).read_text(encoding="utf-8")


def test_published_feedback_gives_both_values_and_its_request_the_author(tmp_path: Path) -> None:
    setpoint = names.ZCTRL_SETPOINT
    folder = recorded(
        tmp_path,
        (1, Feedback(True, 0.5, 100.0, 8.0)),
        request(10, "gentle", ControlRequest.SET_ZCTRL_PARAMS),
        (10.2, Feedback(True, 0.5, 100.0, 6.0)),
        (11.5, Feedback(False, 0.5, 100.0, 6.0)),
        (20, Feedback(True, 0.5, 100.0, 6.0)),
        request(30, "repair", ControlRequest.ACTION, names.CRASH),
        (29.8, Feedback(False, 0.5, 100.0, 6.0)),
        request(40, "series", ControlRequest.ACTION, names.START_SCAN),
        (40.1, Feedback(True, 0.25, 100.0, 6.0)),
    )
    assert changes(folder) == [
        (10.2, "gentle", setpoint, "8", "6"),
        (11.5, "", names.FEEDBACK_ON, "on", "off"),
        (20.0, "", names.FEEDBACK_ON, "off", "on"),
        (29.8, "repair", names.FEEDBACK_ON, "on", "off"),
        (40.1, "", names.FEEDBACK_ON, "off", "on"),
        (40.1, "", names.ZCTRL_PGAIN, "0.5", "0.25"),
    ]
    text = write(folder).read_text(encoding="utf-8")
    assert "<td>no request</td>" in text
    assert "The setpoint is recorded without its unit" in text


@pytest.mark.parametrize(("speed", "who"), [(1.0, ""), (100.0, "gentle")])
def test_change_published_late_in_a_fast_clock_has_its_author(tmp_path: Path, speed: float, who: str) -> None:
    folder = recorded(
        tmp_path,
        (1, Feedback(setpoint=8.0)),
        request(10, "gentle", ControlRequest.SET_ZCTRL_PARAMS),
        (50, Feedback(setpoint=6.0)),
        speed=speed,
    )
    assert [one[1] for one in changes(folder)] == [who]


def test_setpoint_set_with_a_unit_is_one_change_with_that_unit(tmp_path: Path) -> None:
    folder = recorded(
        tmp_path,
        (1, Feedback(setpoint=0.5)),
        sets(10, ADA, names.ZCTRL_SETPOINT, "250", "mV"),
        (10.1, Feedback(setpoint=0.25)),
    )
    assert changes(folder) == [(10.1, ADA, names.ZCTRL_SETPOINT, "500 mV", "250 mV")]
    assert "without its unit" not in write(folder).read_text(encoding="utf-8")


def test_setpoint_is_known_from_requests_where_no_feedback_is_published(tmp_path: Path) -> None:
    folder = recorded(tmp_path, sets(10, ADA, names.ZCTRL_SETPOINT, "250", "mV"))
    assert changes(folder) == [(10.0, ADA, names.ZCTRL_SETPOINT, "", "250 mV")]


def test_many_changes_are_one_row_that_opens(tmp_path: Path) -> None:
    bias = names.TIP_BIAS_VOLTAGE
    swept = [sets(k, "sweep <b>", bias, str(k), "V") for k in range(1, 501)]
    text = write(recorded(tmp_path, *swept, sets(600, ADA, bias, "0.1", "V"))).read_text(encoding="utf-8")
    section = text[text.index("<h2>Parameters changed</h2>") :].partition("</section>")[0]
    assert section.count(f"<td>{bias}</td>") == 2
    row = section[section.index("<td>sweep &lt;b&gt;</td>") :]
    values = "<td>500</td><td>not known</td><td>500 V</td>"
    period = "<td><details><summary>22:13:21 … 22:21:40</summary>"
    assert row.startswith(f"<td>sweep &lt;b&gt;</td>{values}{period}")
    assert row.count("<td>22:") == parameters.MOST_LISTED + 1
    assert "300 more changes in the record" in row
    assert f"<td>{ADA}</td><td>1</td><td>500 V</td><td>100 mV</td><td>22:23:20" in section
