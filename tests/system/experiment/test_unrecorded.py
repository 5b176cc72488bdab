"""A run that is stopped while its recorder is behind says so, and how to get the results."""

from __future__ import annotations

from pathlib import Path

import pytest
from systems import HAS_CONSOLE, WINDOWS, interrupt
from tests.system.experiment.experiment_lab import Run, lasting

import afspm


@pytest.mark.skipif(WINDOWS or not HAS_CONSOLE, reason="there the whole console gets the Ctrl-C")
def test_end_and_open_run_name_the_scans_that_a_frozen_recorder_left(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # faults A3
    one = run(over=lasting(tmp_path) + "[restart]\nbeat_period = 1.0\nmissed_beats = 600\n", scans=1000)
    one.wait_for(r" series .*scan 2 of")
    one.freeze("recorder")
    one.wait_for_next(r" series .*scan \d+ of")
    one.wait_for_next(r" series .*scan \d+ of")
    interrupt(one.process)
    assert one.end() == 130, one.output
    lacking = r"the record lacks \d+ channels of scans and spectra that the packet log still has; `afspm run --resume"
    one.wait_for(lacking)
    with afspm.open_run(one.folder):
        assert "the record lacks" in caplog.text
