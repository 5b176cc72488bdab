"""Two experiments with the same addresses: the second starts nothing, and no component joins the wrong one."""

from __future__ import annotations

import json
import shutil
import socket
from pathlib import Path

import pytest
from tests.system.experiment.experiment_lab import AfspmRun, Run, lasting

import afspm
from afspm.basics.errors import ConfigError
from afspm.supervisor.ports import FreePorts

ADDRESSES = """
[scheduler]
pubsubcache = "tcp://127.0.0.1:{}"
router = "tcp://127.0.0.1:{}"

[microscope]
publisher = "tcp://127.0.0.1:{}"
control_server = "tcp://127.0.0.1:{}"
"""


def addresses() -> str:
    ports = FreePorts()
    return ADDRESSES.format(*(ports.take() for _ in range(4)))


def refused(second: AfspmRun) -> str:
    """Return the output of a run that ends without starting a process."""
    assert second.end() == 1
    assert "started, process" not in second.output
    return " ".join(second.output.split())


def test_second_experiment_on_the_same_ports_ends_at_once_and_leaves_the_first_running(
    run: Run, tmp_path: Path
) -> None:
    where = addresses()
    first = run(over=where + lasting(tmp_path), scans=1000)
    first.wait_for("series .*scan 1")
    second = run(over=where, scans=1000, where=tmp_path)
    assert "another program listens at tcp://127.0.0.1:" in refused(second)
    assert len(list((tmp_path / "runs").glob("*-*/run.json"))) == 1
    first.end_lasting()
    assert set(first.witnessed().values()) == {1}


def test_port_of_another_program_ends_the_run_too(run: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        over = f'[scheduler]\nrouter = "tcp://127.0.0.1:{other.getsockname()[1]}"\n'
        assert "[scheduler] another program listens at" in refused(run(over=over))


def test_request_for_another_run_is_refused(run: Run, tmp_path: Path) -> None:
    """A notebook whose run has ended finds another experiment at the same address."""
    first = run(over=addresses() + lasting(tmp_path), scans=1000)
    first.wait_for("series .*scan 1")
    facts = first.facts()
    assert facts["run"] == facts["guest"]["run"]
    facts["run"] = facts["guest"]["run"] = "0123456789abcdef"
    other = tmp_path / "other"
    (other / "state").mkdir(parents=True)
    shutil.copy(first.folder / "state" / "guest.keys", other / "state" / "guest.keys")
    (other / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    with pytest.raises(ConfigError, match="of another run"), afspm.connect(other) as scope:
        scope.get("scan-speed")
    with afspm.connect(first.folder, "another") as scope:
        assert scope.get("scan-speed")
    first.end_lasting()
