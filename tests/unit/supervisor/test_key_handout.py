"""Each process gets only its own keys, of the file or made for the run."""

from __future__ import annotations

import itertools
import json
import stat
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from afspm.basics.errors import ConfigError
from afspm.client.connect import GUEST_KEYS, _keys_in
from afspm.experiment import Experiment, load
from afspm.supervisor import run as running
from afspm.supervisor import run_folder
from afspm.supervisor.key_handout import KeyHandout, hand_over
from afspm.supervisor.run import RunOptions
from afspm.transport.keys import Keys, from_launch, generate

FILE = """
[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"
{router}

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]

[other]
component = true
command = ["python", "x.py"]

[record]
on = false
"""
WRITTEN = 'router = "tcp://127.0.0.1:29103"'


def experiment(folder: Path, more: str = "", router: str = "") -> Experiment:
    file = folder / "experiment.toml"
    file.write_text(FILE.format(router=router) + more, encoding="utf-8")
    return load(file)


def handed(made: Experiment, **which: Any) -> KeyHandout:
    ports = itertools.count(21_000)
    return hand_over(made, made.launches(take_address=lambda: f"tcp://127.0.0.1:{next(ports)}", **which))


def lines(found: KeyHandout) -> dict[str, Mapping[str, Any]]:
    return {start.launch.name: start.launch.keys or {} for start in found.starts}


def test_each_process_gets_its_own_pair_and_the_public_keys_of_its_peers(tmp_path: Path) -> None:
    found = handed(experiment(tmp_path))
    keys = lines(found)
    secrets = {name: own["secret"] for name, own in keys.items()}
    assert len(set(secrets.values())) == 4
    for start in found.starts:
        text = start.launch.to_json()
        assert [name for name, secret in secrets.items() if secret in text] == [start.launch.name]
    assert {name: set(own["peers"].values()) for name, own in keys.items()} == {
        "microscope": {"scheduler"},
        "scheduler": {"microscope", "scheduler", "series", "other", "supervisor", "guest"},
        "series": {"scheduler"},
        "other": {"scheduler"},
    }
    assert {name: own["guards"] for name, own in keys.items()} == {
        "microscope": True, "scheduler": True, "series": False, "other": False,
    }  # fmt: skip
    assert not any(own["everywhere"] for own in keys.values())
    assert found.guest is not None
    assert found.supervisor is not None
    servers: Any = found.guest["servers"]
    assert set(servers.values()) == {"scheduler"}


PUBLISHING = """
[writer]
component = true
command = ["python", "y.py"]
publisher = "tcp://127.0.0.1:29104"
"""


def test_every_port_has_keys_and_of_unix_sockets_those_of_requests(tmp_path: Path) -> None:
    made = experiment(tmp_path, PUBLISHING)
    for scheme, published in (("tcp://127.0.0.1:", {"scheduler", "microscope"}), ("ipc:///x/", set[str]())):
        addresses = (f"{scheme}{number}" for number in range(21_000, 22_000))
        found = hand_over(made, made.launches(take_address=partial(next, addresses)))
        for start in found.starts:
            sockets, own = start.launch.sockets, from_launch(start.launch.name, start.launch.keys)
            assert own is not None
            if sockets.serve:
                assert own.binds_encrypted(sockets.serve, requests=True)
            if sockets.publish and start.launch.name != "writer":
                is_encrypted = own.binds_encrypted(sockets.publish, requests=False)
                assert is_encrypted == (start.launch.name in published)
            for address in sockets.subscribe:
                assert (own.server_key(address) is not None) == address.startswith("tcp://")
        # a program in another language knows all or nothing
        assert lines(found)["writer"]["everywhere"] == scheme.startswith("tcp")


def test_keys_are_new_in_each_run(tmp_path: Path) -> None:
    made = experiment(tmp_path)
    assert lines(handed(made))["series"]["secret"] != lines(handed(made))["series"]["secret"]


def test_plain_sockets_of_a_bridge_leave_a_run_its_keys(tmp_path: Path) -> None:
    found = handed(experiment(tmp_path, "[security]\nplain = true\n"))
    assert found.guest is not None
    assert all("secret" in own for own in lines(found).values())


def test_no_keys_are_made_if_the_file_is_insecure(tmp_path: Path) -> None:
    found = handed(experiment(tmp_path, "[security]\ninsecure = true\n"))
    assert found.guest is None
    assert not any("secret" in own for own in lines(found).values())


def test_no_keys_are_made_if_peers_elsewhere_know_the_address(tmp_path: Path) -> None:
    assert "secret" in lines(handed(experiment(tmp_path, router=WRITTEN)))["series"]
    assert "secret" in lines(handed(experiment(tmp_path), without=["other"]))["series"]
    assert "secret" not in lines(handed(experiment(tmp_path, router=WRITTEN), without=["other"]))["series"]


def test_scheduler_in_another_language_is_asked_without_keys(tmp_path: Path) -> None:
    text = FILE.format(router="").replace('class = "Scheduler"', 'command = ["python", "s.py"]\nrole = "scheduler"')
    (tmp_path / "experiment.toml").write_text(text, encoding="utf-8")
    assert not any(lines(handed(load(tmp_path / "experiment.toml"))).values())


def test_each_process_gets_only_its_own_keys_of_the_file(tmp_path: Path) -> None:
    generate(tmp_path / "keys", ["microscope", "scheduler", "series", "other", "supervisor"])
    found = handed(experiment(tmp_path, '[security]\nkeys = "keys"\n'))
    own = lines(found)["series"]
    assert own["folder"] is None
    assert set(own["peers"].values()) == {"scheduler"}
    assert own["everywhere"]
    series = from_launch("series", own)
    assert isinstance(series, Keys)
    assert series.secret.decode() in (tmp_path / "keys" / "private" / "series.key_secret").read_text(encoding="utf-8")
    assert lines(found)["scheduler"]["folder"] == str(tmp_path / "keys" / "public")
    assert "series" in lines(found)["scheduler"]["peers"].values()


@pytest.mark.skipif(sys.platform == "win32", reason="files have no modes there")
def test_a_secret_that_others_may_read_is_refused(tmp_path: Path) -> None:
    generate(tmp_path / "keys", ["microscope", "scheduler", "series", "other", "supervisor"])
    assert stat.S_IMODE((tmp_path / "keys" / "private").stat().st_mode) == 0o700
    loose = tmp_path / "keys" / "private" / "series.key_secret"
    loose.chmod(0o640)
    with pytest.raises(ConfigError, match="other users may read this secret key: its mode is 0640"):
        handed(experiment(tmp_path, '[security]\nkeys = "keys"\n'))


def test_guests_key_is_in_the_run_folder_before_run_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[object] = []

    def write(folder: Path, _facts: object) -> None:
        found.append(_keys_in(folder))
        raise ConfigError("not started")

    monkeypatch.setattr(run_folder, "write_run", write)
    with pytest.raises(ConfigError, match="not started"):
        running.run(experiment(tmp_path), RunOptions(runs=tmp_path / "runs"))
    assert found
    assert found[0] != {}


def test_run_folder_has_the_guests_key_while_the_run_lasts(tmp_path: Path) -> None:
    found = handed(experiment(tmp_path))
    file = tmp_path / "state" / GUEST_KEYS
    with found.laid_down(tmp_path):
        assert _keys_in(tmp_path) == {"keys": json.loads(json.dumps(found.guest))}
        if sys.platform != "win32":
            assert stat.S_IMODE(file.stat().st_mode) == 0o600
            file.chmod(0o644)
            with pytest.raises(ConfigError, match="other users may read"):
                _keys_in(tmp_path)
    assert not file.exists()
    assert _keys_in(tmp_path) == {}
