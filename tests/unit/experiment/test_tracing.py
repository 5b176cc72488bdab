"""Experiments that can trace the traffic with the controller."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.experiment import load
from afspm.experiment.tracing import trace_overlay

FILE = '[scheduler]\ncomponent = true\nclass = "Scheduler"\n[instrument]\ncomponent = true\nclass = "{driver}"\n'


@pytest.mark.parametrize(("driver", "is_traced"), [("Nanonis", True), ("Park", True), ("Simulator", False)])
def test_a_driver_that_talks_to_a_controller_keeps_a_trace(tmp_path: Path, driver: str, is_traced: bool) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(FILE.format(driver=driver), encoding="utf-8")
    overlay = trace_overlay(load(file).resolved, tmp_path)
    assert (overlay is not None) == is_traced
    if overlay is not None:
        instrument = load(file, overlay).resolved.processes["instrument"]
        assert instrument.settings["trace"] is True
