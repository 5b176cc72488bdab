"""An experiment with keys on an emulated controller, and the checks of its translator."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from afspm_process import AFSPM
from deadlines import DEADLINE_S

EXPERIMENT = """
[clock]
speed = 60.0

[controller]
component = true
class = "NanonisEmulator"
surface = "particles"

[microscope]
component = true
class = "Nanonis"

[scheduler]
component = true
class = "Scheduler"

[details]
component = true
class = "ScanList"
regions = [{ center = ["0 nm", "0 nm"], size = ["500 nm", "500 nm"] }]
pixels = [32, 24]
end_when_done = true

[security]
keys = "keys"
"""


def afspm(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*AFSPM, *arguments], cwd=cwd, capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the experiment file, and keys for each of its processes."""
    made = tmp_path_factory.mktemp("with_keys")
    (made / "experiment.toml").write_text(EXPERIMENT, encoding="utf-8")
    assert afspm("keys", "experiment.toml", cwd=made).returncode == 0
    return made


def test_an_experiment_with_keys_scans_on_an_emulated_controller(folder: Path) -> None:
    done = afspm("run", "experiment.toml", "--no-report", cwd=folder)
    assert done.returncode == 0, done.stdout
    assert "scan 1 of 1 at" in done.stdout


def test_the_checks_want_a_key_of_their_own_and_say_which_and_then_find_all_as_it_should_be(folder: Path) -> None:
    checks = ("test-translator", "experiment.toml", "-k", "published", "-k", "frame/set", "-k", "refused/nan")
    refused = afspm(*checks, cwd=folder)
    assert refused.returncode == 1
    assert "afspm keys FILE --also translator_test" in " ".join(refused.stderr.split())
    assert afspm("keys", "experiment.toml", "--also", "translator_test", cwd=folder).returncode == 0
    done = afspm(*checks, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed" in done.stdout
