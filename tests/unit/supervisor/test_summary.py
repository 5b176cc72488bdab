from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm import wire
from afspm.model import Packet, Region, Scan, ScopeState, ScopeStatus, Spectrum
from afspm.record.journal import SCHEDULER
from afspm.record.store import RecordSettings, RecordStore
from afspm.supervisor.post_run import summary
from afspm.supervisor.supervision.run_end import EndReason
from afspm.supervisor.supervision.supervised_child import ProcessReport
from afspm.supervisor.supervisor import RunOutcome

REPORTS = (
    ProcessReport("scheduler", starts=1, given_up=False, last_exit="the experiment has ended"),
    ProcessReport("series", starts=3, given_up=False, last_exit="done"),
    ProcessReport("hopeless", starts=2, given_up=True, last_exit="crashed"),
)


def test_summary_lists_processes_restarts_and_processes_given_up(tmp_path: Path) -> None:
    told = summary(RunOutcome(EndReason.EXPERIMENT_ENDED, "the experiment has ended", REPORTS, 3725.0), tmp_path)
    assert told == [
        "the experiment has ended, after 1 h 02 min",
        "ran: scheduler, series, hopeless",
        "series was restarted twice",
        "hopeless was restarted once",
        "hopeless was GIVEN UP: crashed",
        f"everything is in {tmp_path}",
    ]


def test_summary_names_a_component_that_had_not_finished(tmp_path: Path) -> None:
    how = "stopped 1 min 00 s after the end of the experiment, before it had finished"
    reports = (ProcessReport("drawing", starts=1, given_up=False, last_exit="", unfinished=how),)
    assert f"drawing was {how}" in summary(RunOutcome(EndReason.EXPERIMENT_ENDED, "", reports, 1.0), tmp_path)


def test_a_scan_of_two_channels_is_one_scan(tmp_path: Path) -> None:
    rows = ["time,measurement,channel", "t1,scan,Height", "t1,scan,Phase", "t2,scan,Height", "t3,spectrum,IV"]
    (tmp_path / "metadata.csv").write_text("\n".join(rows), encoding="utf-8")
    told = summary(RunOutcome(EndReason.EXPERIMENT_ENDED, "", (), 1.0), tmp_path)
    assert "measured: 2 scans, 1 spectrum" in told


def test_without_a_table_the_record_is_counted(tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings({}))
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    scans = [Scan(region, channel, "m", np.zeros((2, 2)), 2, "a.nc") for channel in ("Height", "Phase")]
    published: list[Any] = [ScopeStatus(ScopeState.SCANNING), *scans, ScopeStatus(ScopeState.FREE)]
    published += [ScopeStatus(ScopeState.SCANNING), ScopeStatus(ScopeState.INTERRUPTED)]
    published += [Spectrum((0.0, 0.0), "IV", ("Bias",), ("V",), np.zeros((3, 1)), 6, "b")]
    store.take([(Packet(*wire.encode(thing), time_ns), SCHEDULER) for time_ns, thing in enumerate(published)])
    store.settle()
    store.close()
    told = summary(RunOutcome(EndReason.EXPERIMENT_ENDED, "", (), 1.0), tmp_path)
    assert "measured: 1 scan, 1 spectrum; 1 interrupted" in told


def test_a_table_that_can_not_be_read_is_no_reason_to_fail(tmp_path: Path) -> None:
    (tmp_path / "metadata.csv").write_bytes(b"\xff\xfe\x00,\x00")
    assert summary(RunOutcome(EndReason.EXPERIMENT_ENDED, "", (), 1.0), tmp_path)[-1] == f"everything is in {tmp_path}"


@pytest.mark.parametrize("misconfigured", [True, False])
def test_resuming_is_not_offered_where_it_can_only_fail_again(misconfigured: bool, tmp_path: Path) -> None:
    reports = (
        ProcessReport("survey", 1, given_up=True, last_exit="no channel Z", misconfigured=misconfigured),
        ProcessReport("judge", 1, given_up=False, last_exit="the experiment has ended"),
    )
    told = summary(RunOutcome(EndReason.PLANS_LOST, "nothing is left to run", reports, 1.0), tmp_path)
    assert ("would fail again" in told[-1]) is misconfigured
    assert ("--resume" in told[-1]) is not misconfigured


def test_summary_of_a_stopped_run_names_the_command_to_resume(tmp_path: Path) -> None:
    told = summary(RunOutcome(EndReason.STOPPED, "stopped by Ctrl-C", (), 1.0), tmp_path)
    assert told[-2:] == [f"everything is in {tmp_path}", f"`afspm run --resume {tmp_path}` goes on with it"]
