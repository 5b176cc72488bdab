"""Contents of run.json for scripts and notebooks that join."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from afspm.basics.clock import ExperimentClock
from afspm.client.connect import guest_of
from afspm.experiment import load
from afspm.supervisor.ports import FreePorts
from afspm.supervisor.run import run_facts
from afspm.supervisor.run_identity import RunIdentity
from afspm.transport.keys import generate

EXPERIMENT = """
[security]
keys = "keys"

[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"
pubsubcache = "tcp://127.0.0.1:29001"
router = "tcp://127.0.0.1:29002"

[metadata]
component = true
class = "Metadata"
"""


@pytest.mark.parametrize("only", [(), ("microscope", "scheduler"), ("metadata",)])
def test_guest_with_keys_expects_the_scheduler_s_key_on_any_computer(tmp_path: Path, only: tuple[str, ...]) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT)
    generate(tmp_path / "keys", ["microscope", "scheduler", "metadata"])
    starts = load(file).launches(take_address=FreePorts().address, only=only)
    (tmp_path / "run.json").write_text(
        json.dumps(run_facts("night", starts, RunIdentity(ExperimentClock.real(), "ab12", simulated=False)))
    )
    guest = guest_of(tmp_path, "alice")
    assert guest.keys is not None
    assert Path(guest.keys["folder"]) == tmp_path / "keys"
    assert guest.sockets.control is not None
    assert [guest.keys.get(url) for url in (*guest.sockets.subscribe, guest.sockets.control)] == ["scheduler"] * 2
