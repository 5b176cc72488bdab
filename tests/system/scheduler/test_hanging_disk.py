"""A hanging disk: the scheduler goes on serving, and catches up on its writes afterwards."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from afspm.model import ControlMode, ControlRequest, Problem
from afspm.storage.packet_log import log_folder, logged_packets

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="what a descriptor is open on is found in /proc")
HOOK = Path(__file__).parents[2] / "support" / "hanging_disk"


@pytest.fixture
def switch(rig: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The disk hangs while this file exists."""
    state = tmp_path / "state"
    state.mkdir()
    monkeypatch.setenv("PYTHONPATH", str(HOOK))
    monkeypatch.setenv("HANGING_FOLDER", str(state))
    file = tmp_path / "state.hangs"
    yield file
    file.unlink(missing_ok=True)


def test_requests_flags_and_packets_do_not_wait_for_a_hanging_disk(rig: Any, switch: Path, tmp_path: Path) -> None:
    rig.start()
    holder = rig.component("Experiment")
    rig.linked(holder)
    assert holder.ask(ControlRequest.REQUEST_CTRL, 0).ok
    switch.touch()
    assert holder.ask(ControlRequest.ADD_EXP_PRBLM, int(Problem.TIP_SHAPE_CHANGED)).ok
    assert holder.ask(ControlRequest.SET_CONTROL_MODE, int(ControlMode.MANUAL)).ok
    for number in (1, 2):
        rig.publish_packet("FeedbackAnalysis", b"")
        rig.until(lambda number=number: len(holder.packets("FeedbackAnalysis")) == number)
    switch.unlink()
    log = log_folder(tmp_path / "state")
    rig.until(lambda: [entry.packet.envelope for entry in logged_packets(log)].count("FeedbackAnalysis") == 2)
    rig.kill()
    rig.start()
    late = rig.component("Late")
    state = rig.until(lambda: late.packets("ControlState"))[-1]
    assert state == holder.packets("ControlState")[-1]
