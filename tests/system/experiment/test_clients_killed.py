"""Clients in other languages take a keyed scan once, whichever process is killed; `make test-clients` builds them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from systems import WINDOWS
from tests.system.experiment.experiment_lab import Run

import afspm
from afspm.model import ScopeState

ROOT = Path(__file__).parents[3]
SAMPLES = ROOT / "experiments" / "other_language"
BUILT = {
    "java": "clients/java/target/afspm-client.jar",
    "rust": "clients/target/release/examples/flattest",
}
PROGRAMS = {"java": "java", "rust": ""}
"""What runs a client; empty: it is a program itself."""
SLOWER = '[clock]\nspeed = 60.0\n[microscope]\ninitial = { scan-speed = "0.5 um/s" }\n'


def wait_until_it_scans(folder: Path) -> None:
    """Wait until a scan is under way."""
    with afspm.connect(folder, "onlooker") as scope:
        assert scope.wait_until(lambda: scope.state is ScopeState.SCANNING, timeout_s=DEADLINE_S)


@pytest.mark.parametrize("killed", ["flattest", "microscope", "scheduler"])
@pytest.mark.parametrize("client", BUILT)
def test_a_keyed_scan_of_a_client_is_taken_once(afspm_run: Run, tmp_path: Path, client: str, killed: str) -> None:
    program = PROGRAMS[client]
    # what was built beside a Windows Python under Wine is a program of the Linux around it
    if not (ROOT / BUILT[client]).exists() or (program and shutil.which(program) is None) or (WINDOWS and not program):
        pytest.skip(f"clients/{client} is not built for this system: make test-clients CLIENTS={client}")
    slower = tmp_path / "slower.toml"
    slower.write_text(SLOWER, encoding="utf-8")
    files = (SAMPLES / "experiment.toml", SAMPLES / f"{client}.toml", slower)
    run = afspm_run(*map(str, files), "--runs", str(tmp_path / "runs"))
    run.wait_for("scheduler .*is up$")
    wait_until_it_scans(run.folder)
    run.kill(killed)
    assert run.end() == 0, run.output
    run.wait_for("the flattest place")
    with afspm.open_run(run.folder) as record:
        assert len(record.scans.where(lambda row: not row.interrupted)) == 2, run.output
