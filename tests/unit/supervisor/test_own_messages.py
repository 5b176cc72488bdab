"""Messages of a run that its user has made: found again beside the experiment file, from any folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from declared_messages import forget_afterwards

from afspm import wire
from afspm.supervisor import own_runs

MODULE = """
from google.protobuf.wrappers_pb2 import FloatValue
from afspm.wire import MessageDeclaration

TILT = MessageDeclaration(type=FloatValue, relayed=True)
"""


@pytest.mark.parametrize("is_own", [True, False], ids=["own run", "received run"])
def test_messages_are_imported_from_the_folder_of_the_experiment_file_of_an_own_run_alone(
    is_own: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    forget_afterwards(monkeypatch)
    monkeypatch.setattr(own_runs, "state_folder", lambda: tmp_path / "state")
    lab, run = tmp_path / "lab", tmp_path / "lab" / "runs" / "night"
    run.mkdir(parents=True)
    (lab / "tilt_beside_the_file.py").write_text(MODULE)
    homes = own_runs.signed(run, [str(lab)]) if is_own else {own_runs.HOMES: [str(lab)]}
    (run / "run.json").write_text(json.dumps(homes))
    own_runs.register_own_messages(run, ["tilt_beside_the_file"])
    assert ("FloatValue" in wire.messages_without_values()) is is_own
    assert ("messages of tilt_beside_the_file are not read" in caplog.text) is not is_own
