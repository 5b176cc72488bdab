"""Every sample runs as it is, to its end; here with fewer pixels and less to do. (Those of tip repair, of the makers'
controllers and of the drift night run elsewhere.)"""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from experiment_lab import Run

import afspm
from afspm.supervisor.ports import FreePorts

EXPERIMENTS = Path(__file__).parents[3] / "experiments"
SERIES = '[series]\nscans = 2\nevery = "2 min"\npixels = [16, 16]\n'
QUICKER: dict[str, tuple[str, int, int]] = {
    "keep_scanning": ('[series]\nduration = "15 min"\npixels = [16, 16]\n', 1, 0),
    "scan_list": ('[list]\nevery = "5 min"\npixels = [16, 8]\n', 6, 0),
    "region_grid": ("[grid]\ncounts = [2, 2]\npixels = [16, 16]\n", 4, 0),
    "spectroscopy_grid": ("[curves]\ncounts = [2, 2]\n", 0, 4),
    "picture": ("[clock]\nspeed = 600.0\n[details]\npixels = [16, 12]\n", 3, 0),
    "own_component": (SERIES, 2, 0),
    "other_language": (SERIES, 2, 0),
    "two_computers": (SERIES, 2, 0),
    "wide_and_narrow": ("[list]\nrounds = 1\npixels = [16, 16]\n", 4, 0),
    "feedback_gains": ('[series]\nduration = "90 min"\npixels = [32, 32]\n', 4, 0),
    "paper_form": ('scan_pixels = [16, 16]\n[series]\nduration = "10 min"\n', 1, 0),
}
"""What is other than in the sample, and how many scans and spectra come of it."""
FOR_A_TIME = {"feedback_gains", "keep_scanning", "paper_form"}  # and as many more as a busy computer finds time for
ADDRESS = re.compile(r'^(\w+) = "tcp://127\.0\.0\.1:\d+"$', re.MULTILINE)
SAYS = {
    "feedback_gains": (
        "is too slow",
        "tuner +integral gain 1280: the feedback follows",
        "oscillates",
        "integral gain 3125$",
    )
}
"""What the log has to say, in this order."""


@pytest.mark.parametrize("name", QUICKER)
def test_a_sample_runs_to_its_end(afspm_run: Run, tmp_path: Path, name: str) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("PIL")
    quicker, scans, spectra = QUICKER[name]
    sample, second, ports = EXPERIMENTS / name / "experiment.toml", tmp_path / "quicker.toml", FreePorts()
    addresses = [f'{use} = "{ports.address()}"\n' for use in ADDRESS.findall(sample.read_text(encoding="utf-8"))]
    second.write_text("".join(addresses) + quicker, encoding="utf-8")
    one = afspm_run(str(sample), str(second), "--runs", str(tmp_path / "runs"))
    assert one.end() == 0, one.output
    assert not [line for line in one.lines if re.search(r" (ERROR|CRITICAL) ", line)], one.output
    assert re.search(".*".join(SAYS.get(name, ())), one.output, re.DOTALL | re.MULTILINE), one.output
    with afspm.open_run(one.folder) as record:
        taken = min(len(record.scans), scans) if name in FOR_A_TIME else len(record.scans)
        assert (taken, len(record.spectra)) == (scans, spectra), one.output
