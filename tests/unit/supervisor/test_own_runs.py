"""A run folder is known as the user's own by a signature, which another folder lacks."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from afspm.supervisor import own_runs


class Received:
    """A run folder in the folder of downloads."""

    def __init__(self, folder: Path) -> None:
        self.night = folder / "downloads" / "night"
        self.night.mkdir(parents=True)
        self.facts({"homes": [str(self.night), ".", "night", "downloads/night"]})

    def facts(self, facts: Any) -> None:
        (self.night / "run.json").write_text(json.dumps(facts))


@pytest.fixture
def received(tmp_path: Path) -> Received:
    return Received(tmp_path)


def test_only_the_signed_folder_is_known_as_own(received: Received, tmp_path: Path) -> None:
    homes = [str(tmp_path / "lab")]
    facts = own_runs.signed(received.night, homes)
    received.facts(facts)
    assert own_runs.own_homes(received.night) == [tmp_path / "lab"]
    (tmp_path / "latest").symlink_to(received.night)
    assert own_runs.own_homes(tmp_path / "latest") == [tmp_path / "lab"]

    received.facts({**facts, "homes": [str(received.night)]})
    assert own_runs.own_homes(received.night) is None
    contents: list[Any] = [{**facts, "signature": wrong} for wrong in (3, "ä", "")]
    for content in [*contents, {"homes": homes}, [], {**facts, "homes": [1]}]:
        received.facts(content)
        assert own_runs.own_homes(received.night) is None

    received.facts(facts)
    copy = tmp_path / "copy"
    shutil.copytree(received.night, copy)
    assert own_runs.own_homes(copy) is None
    received.night.rename(tmp_path / "moved")
    assert own_runs.own_homes(tmp_path / "moved") is None
    copy.rename(received.night)  # another folder in the place of the run
    assert own_runs.own_homes(received.night) is None
    shutil.rmtree(received.night)
    received.night.symlink_to(tmp_path / "moved")
    assert own_runs.own_homes(received.night) is None


def test_run_of_another_user_is_not_own(received: Received, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    received.facts(own_runs.signed(received.night, []))
    for name in ("XDG_STATE_HOME", "LOCALAPPDATA", "HOME"):
        monkeypatch.setenv(name, str(tmp_path / "other"))
    assert own_runs.own_homes(received.night) is None
    own_runs.signed(received.night, [])
    assert own_runs.own_homes(received.night) is None


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such permissions")
def test_key_is_private(received: Received, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("XDG_STATE_HOME", "HOME"):
        monkeypatch.setenv(name, str(tmp_path / "new"))
    own_runs.signed(received.night, [])
    (key,) = own_runs.state_folder().iterdir()
    assert (key.stat().st_mode & 0o777, key.stat().st_size) == (0o600, 32)


def test_run_goes_on_unsigned_without_a_place_for_the_key(
    received: Received, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(own_runs, "state_folder", lambda: tmp_path / "file" / "afspm")
    assert own_runs.signed(received.night, ["lab"]) == {"homes": ["lab"]}
    assert "will not be known as yours" in caplog.text
    assert own_runs.own_homes(received.night) is None


def test_messages_of_a_received_run_are_not_imported_by_a_follower(
    received: Received, caplog: pytest.LogCaptureFixture
) -> None:
    own_runs.register_own_messages(received.night, ["own_"])
    assert "messages of own_ are not read" in caplog.text
