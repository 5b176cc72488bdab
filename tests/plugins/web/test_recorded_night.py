"""A recorded night at its moments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm import open_run, wire
from afspm.components import append_note
from afspm.model import (
    ControlMode,
    ControlState,
    LogLine,
    Note,
    Packet,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Region,
    Scan,
    Spectrum,
)
from afspm.model.events import LogLines
from afspm.plugins.web.dashboard.content import Contents
from afspm.plugins.web.dashboard.night import Night, NightWatch
from afspm.record.journal import SCHEDULER
from afspm.record.store import RecordSettings, RecordStore

S = 1_000_000_000
START = 1_773_518_400 * S
PROCESS = ProcessState("series", "component", ProcessCondition.ALIVE, START, 0.0, 1, 7, "")
FOUND = {"matrix": [1.0, 0.0, -30e-9, 0.0, 1.0, 10e-9], "center": [30e-9, -10e-9], "correcting": True}


def scan(at_s: int) -> Scan:
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    return Scan(region, "Height", "m", np.full((4, 4), float(at_s)), START + at_s * S, f"s{at_s}.nc")


def spectrum(at_s: int) -> Spectrum:
    return Spectrum((0.0, 0.0), "IV", ("Bias", "Current"), ("V", "A"), np.ones((3, 2)), START + at_s * S, "c.nc")


def mapping() -> Any:
    return wire.message_type("DriftMapping")(**FOUND)


@pytest.fixture
def night(tmp_path: Path) -> Night:
    """Two scans, a spectrum, a change of control and a line of the log; the second scan has drifted."""
    things = [
        (0, ControlState(ControlMode.AUTOMATED, "series")),
        (5, ProcessStates(START + 5 * S, "lab", (PROCESS,))),
        (10, scan(10)),
        (20, ControlState(ControlMode.MANUAL)),
        (25, LogLines((LogLine(START + 25 * S, "series", "INFO", "waits"),))),
        (30, spectrum(30)),
        (39, mapping()),
        (40, scan(40)),
    ]
    store = RecordStore(tmp_path, RecordSettings({"experiment": "night", "simulated": True}))
    for at_s, thing in things:
        name, payload = wire.encode(thing)
        store.take([(Packet(name, payload, START + at_s * S + 1), SCHEDULER)])
    store.finish()
    store.close()
    return Night(tmp_path)


def test_a_night_at_each_moment_equals_the_live_state(night: Night) -> None:
    watch = NightWatch(night)
    assert (len(watch.overview.scans), watch.overview.control) == (2, ControlState(ControlMode.MANUAL))
    assert watch.tip_to_sample is not None
    watch.go(START + 15 * S)
    assert (len(watch.overview.scans), watch.overview.control) == (1, ControlState(ControlMode.AUTOMATED, "series"))
    assert (len(watch.overview.log), watch.spectra.newest(), watch.tip_to_sample) == (0, [], None)
    watch.go(START + 35 * S)
    assert (len(watch.overview.log), watch.moment_ns) == (1, START + 35 * S)
    ((_, found),) = watch.spectra.newest()
    assert found.values.tolist() == np.ones((3, 2)).tolist()


def test_no_process_is_alive_after_the_run(night: Night) -> None:
    watch = NightWatch(night)
    contents = Contents(watch, None)
    (process,) = contents.get().processes
    assert (process.condition, process.since_ns) == (ProcessCondition.ENDED, watch.overview.newest_ns)
    watch.go(START + 15 * S)
    (process,) = contents.get().processes
    assert process.condition is ProcessCondition.ALIVE


def test_in_manual_mode_the_page_says_that_a_person_is_in_control(night: Night) -> None:
    contents = Contents(NightWatch(night), None)
    assert "a person</b> is in control" in contents.get().status


def test_going_forth_and_back_gives_the_same_state(night: Night) -> None:
    watch, straight = NightWatch(night), NightWatch(night)
    for at_s in (5, 41, 12, 30, 22):
        watch.go(START + at_s * S)
    straight.go(START + 22 * S)
    assert watch.overview.scans == straight.overview.scans
    assert watch.overview.timelines.control.spans == straight.overview.timelines.control.spans


def test_the_page_shows_the_moment(night: Night) -> None:
    watch = NightWatch(night)
    contents = Contents(watch, None)
    assert "MANUAL" in contents.get().status
    assert contents.get().trouble == ""
    watch.go(START + 15 * S)
    assert "AUTOMATED" in contents.get().status
    assert contents.get().channels == ("Height",)
    assert contents.get().slow.time_line != ""


def test_a_later_note_stands_at_the_moment_that_it_describes(night: Night) -> None:
    watch, other = NightWatch(night), NightWatch(night)
    contents = Contents(watch, None)
    contents.get()
    append_note(night.folder, "terminal:ada", "double tip", 7, scan(10).time_ns)
    append_note(night.folder, "terminal:ada", "<i>really</i>", 8, scan(10).time_ns)
    night.reload()
    assert "scan 1" in contents.get().notes
    assert "&lt;i&gt;really" in contents.get().notes
    watch.go(START + 15 * S)
    assert [note.text for note in watch.overview.notes] == ["double tip", "<i>really</i>"]
    watch.go(START + 5 * S)
    assert not watch.overview.notes
    with other.reading() as overview:
        assert len(overview.notes) == 2
    assert isinstance(overview.notes[0], Note)


def test_the_flip_book_has_the_scans_with_a_known_place(night: Night) -> None:
    ((number, found),) = night.drifted().items()
    assert (number, found.tip_m) == (2, (30e-9, -10e-9))
    assert found.sample_m == pytest.approx((0.0, 0.0), abs=1e-15)
    assert night.published_ns() == {scan(at_s).time_ns: START + at_s * S + 1 for at_s in (10, 40)}


def test_damaged_spectrum_is_logged_once(night: Night, caplog: pytest.LogCaptureFixture) -> None:
    with open_run(night.folder) as run:
        (row,) = run.spectra
    (night.folder / row.file).write_bytes(b"damaged")
    for _ in range(2):
        assert not night.spectra_until(START + 60 * S).newest()
    (line,) = caplog.messages
    assert line.startswith("a spectrum is not shown: "), line
