"""A component that sweeps a generator against a lock-in at each place, and records its own spectra."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tests.system.experiment.experiment_lab import Run
from tests.system.secop.test_lock_in import EXPERIMENT, PEAK_GHZ, served

import afspm

SPECTRA = """
[clock]
speed = 4.0

[esr]
component = true
class = "SweepAt"
parameter = "lab.rf"
values = { from = "13 GHz", to = "17 GHz", points = 21 }
read = ["lab.x"]
settle = "50 ms"
counts = [2, 2]
spacing = ["10 nm", "10 nm"]
end_when_done = true
"""


def test_sweep_at_each_place_is_recorded_once_though_its_component_is_killed(afspm_run: Run, tmp_path: Path) -> None:
    with served() as port:
        file = tmp_path / "esr.toml"
        file.write_text(EXPERIMENT.replace("PORT", str(port)) + SPECTRA, encoding="utf-8")
        one = afspm_run(str(file), "--runs", str(tmp_path / "runs"))
        for done in (1, 3):
            one.wait_for(f"spectrum {done} of 4")
            one.kill("esr")
        assert one.end() == 0, one.output
    with afspm.open_run(one.folder) as record:
        rows = list(record.spectra)
        curves = [record.spectrum(row) for row in rows]
        set_back = [entry.what for entry in record.journal if entry.what.startswith("lab.rf = ")][-1]
    assert len(rows) == len({row.position_m for row in rows}) == 4, one.output
    assert {row.holder for row in rows} == {"esr"}
    assert all(row.began_ns is not None and row.began_ns < row.time_ns for row in rows)
    for curve in curves:
        assert (curve.kind, curve.names, curve.units) == ("lab.rf", ("lab.rf", "lab.x"), ("Hz", "V"))
        ghz = 1e-9 * curve["lab.rf"]
        np.testing.assert_allclose(ghz, np.linspace(13.0, 17.0, 21))
        np.testing.assert_allclose(curve["lab.x"], np.exp(-((ghz - PEAK_GHZ) ** 2)))
    assert set_back == "lab.rf = 12.0 GHz"
