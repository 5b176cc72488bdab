"""The table of measurements: right, complete, and without duplicates."""

from __future__ import annotations

import csv
import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_lab import REGION, Lab, Nothing, context_of, run

from afspm.basics.clock import iso_utc
from afspm.basics.exit_codes import ExitCode
from afspm.components.line_file import LineFile
from afspm.components.metadata import COLUMNS, Metadata
from afspm.model import (
    ControlEvent,
    ControlMode,
    ControlRequest,
    ControlResponse,
    ControlState,
    Feedback,
    JournalEntries,
    JournalEntry,
    Note,
    Problem,
    Scan,
    ScopeState,
    ScopeStatus,
    Spectrum,
    names,
)
from afspm.scheduler.control import arbitration as a


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metadata.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def scanned(lab: Lab, at_s: float) -> None:
    """Let another client take a scan of 100 s."""
    lab.at(at_s, lambda: lab.go(ScopeState.FREE))
    lab.at(at_s, lambda: lab.go(ScopeState.SCANNING))
    lab.at(at_s + 100.0, lambda: lab.publish_scan(REGION))
    lab.at(at_s + 100.0, lambda: lab.go(ScopeState.FREE))


def held_by(lab: Lab, name: str, at_s: float) -> None:
    lab.at(at_s, lambda: lab.does(a.ArbitrationEvent.REQUEST_CONTROL, name))


def test_each_channel_has_a_row_with_place_and_holder_of_control_at_its_beginning(tmp_path: Path) -> None:
    lab = Lab("metadata")
    held_by(lab, "series", 5.0)
    scanned(lab, 10.0)
    lab.at(50.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))  # control is lost, which stops it in this laboratory
    lab.at(50.0, lambda: lab.publish_scan(REGION))  # but not on every microscope
    lab.at(300.0, lab.kill)
    assert run(Metadata(), lab, run_dir=str(tmp_path)) == ExitCode.ENDED
    found = rows(tmp_path)
    assert [row["channel"] for row in found[:2]] == ["Height", "Phase"]
    first = found[0]
    assert (first["in_control"], first["mode"], first["problems"]) == ("series", "automated", "")
    assert (first["center_x"], first["width"], first["length_units"]) == ("0", "1e-06", "m")
    assert (first["columns"], first["rows"], first["units"]) == ("8", "8", "m")


def test_row_has_mode_and_problems_at_the_beginning_of_the_scan(tmp_path: Path) -> None:
    lab = Lab("metadata")
    lab.at(5.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(6.0, lambda: lab.set_mode(ControlMode.MANUAL))
    scanned(lab, 10.0)
    lab.at(60.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    lab.at(300.0, lab.kill)
    run(Metadata(), lab, run_dir=str(tmp_path))
    assert {(r["in_control"], r["mode"], r["problems"]) for r in rows(tmp_path)} == {
        ("", "manual", "tip-shape-changed")
    }


def test_person_that_pauses_a_scan_has_not_begun_it(tmp_path: Path) -> None:
    lab = Lab("metadata")
    held_by(lab, "series", 5.0)
    scanned(lab, 10.0)
    lab.at(40.0, lambda: lab.publish(ControlState(ControlMode.MANUAL)))  # not every microscope stops then
    lab.at(50.0, lambda: lab.publish(ScopeStatus(ScopeState.SCANNING, paused=True)))
    lab.at(60.0, lambda: lab.publish(ScopeStatus(ScopeState.SCANNING)))
    scanned(lab, 200.0)
    lab.at(400.0, lab.kill)
    run(Metadata(), lab, run_dir=str(tmp_path))
    assert [(r["in_control"], r["mode"]) for r in rows(tmp_path)[::2]] == [("series", "automated"), ("", "manual")]


def test_a_spectrum_has_a_row_with_its_position(tmp_path: Path) -> None:
    lab = Lab("metadata")
    spectrum = Spectrum(
        (1e-7, -2e-7), "IV", ("U", "I"), ("V", "A"), np.zeros((5, 2)), 1_700_000_000_000_000_000, "a.dat"
    )
    lab.at(5.0, lambda: lab.publish(spectrum))
    lab.at(10.0, lab.kill)
    run(Metadata(), lab, run_dir=str(tmp_path))
    (row,) = rows(tmp_path)
    assert (row["measurement"], row["channel"], row["filename"]) == ("spectrum", "IV", "a.dat")
    assert (row["center_x"], row["center_y"]) == ("1e-07", "-2e-07")
    assert row["time"] == "2023-11-14T22:13:20.000000Z"


@pytest.mark.parametrize("killed_at_s", [50.0, 105.0, 112.0, 160.0, 215.0])
def test_killed_at_any_time_there_is_one_header_and_no_row_twice(tmp_path: Path, killed_at_s: float) -> None:
    lab = Lab("metadata")
    held_by(lab, "series", 5.0)
    scanned(lab, 10.0)
    scanned(lab, 200.0)
    first_life = context_of(lab, tmp_path / "state", run_dir=str(tmp_path))
    lab.at(killed_at_s, lab.parent_goes)
    assert Metadata().run_process(first_life) == ExitCode.ORPHAN
    lab.restart_component()
    lab.at(500.0, lab.kill)
    run(Metadata(), lab, tmp_path / "state", run_dir=str(tmp_path))
    text = (tmp_path / "metadata.csv").read_text()
    assert text.count("measurement") == 1
    found = rows(tmp_path)
    assert len(found) == len({(row["time"], row["channel"]) for row in found}) == 4
    assert {row["in_control"] for row in found} == {"series"}


def test_scan_with_an_unseen_beginning_has_no_holder_of_control(tmp_path: Path) -> None:
    lab = Lab("metadata")
    held_by(lab, "series", 1.0)
    lab.at(5.0, lambda: lab.publish_scan(REGION))
    lab.at(10.0, lab.kill)
    run(Metadata(), lab, run_dir=str(tmp_path))
    assert {row["in_control"] for row in rows(tmp_path)} == {""}


def test_scans_without_time_and_file_have_a_row_each(tmp_path: Path) -> None:
    lab = Lab("metadata")
    for at_s in (5.0, 6.0):
        lab.at(at_s, lambda: lab.publish(Scan(REGION, "Height", "m", np.zeros((8, 8)))))
        lab.at(at_s, lambda: lab.publish(Spectrum(None, "IV", ("U",), ("V",), np.zeros((5, 1)))))
    lab.at(10.0, lab.kill)
    run(Metadata(), lab, run_dir=str(tmp_path))
    assert [row["measurement"] for row in rows(tmp_path)] == ["scan", "spectrum"] * 2
    assert all(row["time"] for row in rows(tmp_path))


@pytest.mark.parametrize("name", ["a\u2028b.nc", "a\x85b.nc", 'a"b,c.nc'])
def test_file_with_any_name_has_one_row_after_a_restart(tmp_path: Path, name: str) -> None:
    lab = Lab("metadata")
    lab.publish(Scan(REGION, "Height", "m", np.zeros((8, 8)), 1_700_000_000_000_000_000, name))
    first_life = context_of(lab, tmp_path / "state", run_dir=str(tmp_path))
    lab.at(5.0, lab.parent_goes)
    assert Metadata().run_process(first_life) == ExitCode.ORPHAN
    lab.restart_component()
    lab.at(20.0, lab.kill)
    run(Metadata(), lab, tmp_path / "state", run_dir=str(tmp_path))
    assert [row["filename"] for row in rows(tmp_path)] == [name]


def test_row_cut_in_two_by_a_kill_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    LineFile(path, "a,b").append(["1,2", "3,4"])
    with path.open("a") as file:
        file.write("5,")
    again = LineFile(path, "a,b")
    assert again.lines() == ["1,2", "3,4"]
    again.append(["5,6"])
    assert path.read_text() == "a,b\n1,2\n3,4\n5,6\n"


def test_header_cut_in_two_by_a_kill_is_written_again(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("a,")
    LineFile(path, "a,b").append(["1,2"])
    assert path.read_text() == "a,b\n1,2\n"


def test_rows_wait_for_room_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "table.csv"
    table = LineFile(path, "a,b")
    table.append(["1,2"])
    with monkeypatch.context() as disk:
        disk.setattr(Path, "open", _full_after(Path.open, 3))
        table.append(["3,4"])
        table.append(["5,6"])
    assert path.read_text() == "a,b\n1,2\n"
    table.append(["7,8"])
    assert path.read_text() == "a,b\n1,2\n3,4\n5,6\n7,8\n"


def test_rows_wait_while_another_program_has_locked_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def locked(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    path = tmp_path / "table.csv"
    table = LineFile(path, "a,b")
    with monkeypatch.context() as disk:
        disk.setattr(Path, "open", locked)
        table.append(["1,2"])
        table.append(["3,4"])
    assert caplog.text.count("lines wait to be written") == 1
    table.append(["5,6"])
    assert path.read_text() == "a,b\n1,2\n3,4\n5,6\n"


def _full_after(real: Any, room: int) -> Any:
    def opened(path: Path, mode: str) -> Any:
        file = real(path, mode)
        written = file.write

        class Full:
            def __enter__(self) -> Full:
                return self

            def __exit__(self, *_: object) -> None:
                file.close()

            def write(self, data: bytes) -> None:
                written(data[:room])
                raise OSError(errno.ENOSPC, "No space left on device")

        return Full()

    return opened


def test_nothing_measured_leaves_no_file(tmp_path: Path) -> None:
    lab = Lab("metadata")
    with pytest.raises(Nothing):
        run(Metadata(), lab, run_dir=str(tmp_path))
    assert not (tmp_path / "metadata.csv").exists()


def test_times_keep_their_microseconds_and_columns_their_order() -> None:
    assert iso_utc(1_700_000_000_123_456_789) == "2023-11-14T22:13:20.123456Z"
    assert iso_utc(None) == ""
    assert COLUMNS[:4] == ("time", "measurement", "filename", "channel")


BIAS, SETPOINT = names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT
PARAM, ACTION = int(ControlRequest.PARAM), int(ControlRequest.ACTION)


def journal(lab: Lab, at_s: float, *, later_s: float = 0.1, response: int = 0, **codes: Any) -> None:
    """Publish the journal entry of an event at `at_s`, `later_s` after the event."""
    made = lab.clock.now_ns() + round(at_s * 1e9)
    entry = JournalEntry(made, "request", "series", "x", response, sent_ns=made, **codes)
    lab.at(at_s + later_s, lambda: lab.publish(JournalEntries((entry,))))


def measured_with(lab: Lab, at_s: float, later_s: float = 0.2) -> None:
    """Let another client request and take a scan of 100 s."""
    journal(lab, at_s - 0.01, later_s=later_s, request=ACTION, subject=names.START_SCAN)
    scanned(lab, at_s)


def settings_of(folder: Path) -> list[tuple[str, ...]]:
    """Bias and setpoint with their units, for each scan."""
    columns = ("bias", "bias_units", "setpoint", "setpoint_units")
    return [tuple(row[name] for name in columns) for row in rows(folder) if row["channel"] == "Height"]


def test_row_has_the_requested_bias_and_the_published_setpoint_at_the_beginning(tmp_path: Path) -> None:
    lab = Lab("metadata")
    lab.publish(Feedback(setpoint=0.7))
    measured_with(lab, 10.0)
    journal(lab, 199.9, request=PARAM, subject=BIAS, value="-50", unit="mV")
    measured_with(lab, 200.0)
    journal(lab, 250.0, request=PARAM, subject=BIAS, value="1", unit="V")  # while the scan runs
    journal(lab, 310.0, request=PARAM, subject=BIAS, value="9", unit="V", response=int(ControlResponse.PARAM_ERROR))
    journal(lab, 320.0, request=PARAM, subject=SETPOINT, value="500", unit="mV")
    lab.at(320.0, lambda: lab.publish(Feedback(setpoint=0.5)))
    measured_with(lab, 400.0)
    lab.at(600.0, lab.kill)
    run(Metadata(), lab, run_dir=str(tmp_path))
    assert settings_of(tmp_path) == [
        ("", "", "0.7", "V"),
        ("-0.05", "V", "0.7", "V"),
        ("1", "V", "0.5", "V"),
    ]


@pytest.mark.parametrize(
    "event",
    [
        {"request": PARAM, "subject": BIAS, "value": "2", "unit": "V", "response": int(ControlResponse.NO_RESPONSE)},
        {"event": ControlEvent.MODE_CHANGED, "mode": ControlMode.MANUAL},
        {"event": ControlEvent.RESTARTED},
    ],
    ids=["unanswered", "manual", "scheduler killed"],
)
def test_bias_is_unknown_after_what_may_have_changed_it_until_the_next_request(
    tmp_path: Path, event: dict[str, Any]
) -> None:
    lab = Lab("metadata")
    journal(lab, 5.0, request=PARAM, subject=BIAS, value="1", unit="V")
    measured_with(lab, 10.0)
    journal(lab, 150.0, **event)
    measured_with(lab, 200.0)
    journal(lab, 350.0, request=PARAM, subject=BIAS, value="3", unit="V")
    measured_with(lab, 400.0)
    lab.at(600.0, lab.kill)
    run(Metadata(), lab, run_dir=str(tmp_path))
    assert [row[0] for row in settings_of(tmp_path)] == ["1", "", "3"]


def test_bias_is_unknown_for_a_lost_controller_and_a_scan_begun_at_the_panel(tmp_path: Path) -> None:
    lab = Lab("metadata")
    journal(lab, 5.0, request=PARAM, subject=BIAS, value="1", unit="V")
    scanned(lab, 10.0)
    measured_with(lab, 200.0)
    lab.at(350.0, lambda: lab.publish(ScopeStatus(ScopeState.UNDEFINED)))
    measured_with(lab, 400.0)
    lab.at(600.0, lab.kill)
    run(Metadata(), lab, run_dir=str(tmp_path))
    assert [row[0] for row in settings_of(tmp_path)] == ["", "1", ""]


def test_bias_is_unknown_if_the_journal_comes_after_the_scan(tmp_path: Path) -> None:
    lab = Lab("metadata")
    journal(lab, 5.0, request=PARAM, subject=BIAS, value="1", unit="V")
    journal(lab, 199.0, later_s=110.0, request=PARAM, subject=BIAS, value="2", unit="V")
    measured_with(lab, 200.0, later_s=110.0)
    lab.at(600.0, lab.kill)
    run(Metadata(), lab, run_dir=str(tmp_path))
    assert [row[0] for row in settings_of(tmp_path)] == [""]


@pytest.mark.parametrize(("missed", "bias"), [(False, "1"), (True, "")])
def test_bias_survives_a_restart_unless_a_part_of_the_journal_is_missing(
    tmp_path: Path, missed: bool, bias: str
) -> None:
    lab = Lab("metadata")
    journal(lab, 5.0, request=PARAM, subject=BIAS, value="1", unit="V")
    first_life = context_of(lab, tmp_path / "state", run_dir=str(tmp_path))
    lab.at(20.0, lab.parent_goes)
    assert Metadata().run_process(first_life) == ExitCode.ORPHAN
    lab.restart_component()
    if missed:  # the cache keeps the newest entries only
        lab.inbox.clear()
        lab.connect()
    measured_with(lab, 100.0)
    lab.at(500.0, lab.kill)
    run(Metadata(), lab, tmp_path / "state", run_dir=str(tmp_path))
    assert [row[0] for row in settings_of(tmp_path)] == [bias]


def note_at(lab: Lab, at_s: float, text: str) -> None:
    lab.at(at_s, lambda: lab.publish(Note(5, "dashboard:Ada", text, scan_ns=5)))


def test_a_note_has_a_row_once_with_its_author_and_the_time_of_its_scan(tmp_path: Path) -> None:
    for _ in range(2):
        lab = Lab("metadata")
        scanned(lab, 10.0)
        note_at(lab, 200.0, "tip changed,\nhere")
        note_at(lab, 200.0, "really")
        lab.at(300.0, lab.kill)
        run(Metadata(), lab, run_dir=str(tmp_path))
    notes = [(row["time"], row["note"]) for row in rows(tmp_path) if row["measurement"] == "note"]
    assert notes == [(iso_utc(5), "dashboard:Ada: tip changed, here"), (iso_utc(5), "dashboard:Ada: really")]
