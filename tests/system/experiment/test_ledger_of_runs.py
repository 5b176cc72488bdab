"""The ledger of a recorded run with treatments, on the simulator and on an emulated controller."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from afspm_process import AFSPM
from deadlines import DEADLINE_S
from makers import MAKERS

import afspm

FILES = Path(__file__).parents[3] / "experiments" / "every_microscope"
EXPERIMENT = """
[clock]
speed = 20.0

[scheduler]
component = true
class = "Scheduler"

[treats]
component = true
class = "treats.Treats"
"""


MICROSCOPES = {"simulator": FILES / "simulator.toml", "nanonis": MAKERS["nanonis"].emulated}


@pytest.mark.parametrize("microscope", MICROSCOPES)
def test_ledger_and_report_of_a_run_have_its_treatments(microscope: str, tmp_path: Path) -> None:
    (tmp_path / "treats.py").write_text(Path(__file__).with_name("treats.py").read_text(encoding="utf-8"))
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT, encoding="utf-8")
    done = subprocess.run(
        [*AFSPM, "run", str(file), str(MICROSCOPES[microscope]), "--runs", str(tmp_path / "runs")],
        capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    with afspm.open_run(tmp_path / "runs") as run:
        ledger = run.ledger()
        report = (run.folder / "report.html").read_text(encoding="utf-8")
    assert (ledger.pulses, ledger.crashes, ledger.unknown) == (2, 1, 0)
    assert ledger.pulse_v_s == pytest.approx(2 * 4.0 * 0.05)
    assert ledger.crash_depth_m == pytest.approx(5e-9)
    assert ledger.in_keep_away == 1
    assert ledger.by == {"treats": 3}
    assert 25.0 < ledger.feedback_off_s < 300.0
    table = report[report.index("<h2>Treatments of the tip</h2>") :].partition("</section>")[0]
    for shown in ("2, voltage × time together 0.4 V s", "1, depth together 5 nm", "treats 3", "<td>1</td>"):
        assert shown in table
