"""A recorded run is published again, and joined like a running experiment."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from deadlines import DEADLINE_S
from systems import WINDOWS, can_interrupt, interrupt

import afspm
from afspm import wire
from afspm.basics.errors import ConfigError, RequestError, TransportError
from afspm.basics.launch import Launch
from afspm.cli.follower import Follower
from afspm.model import ControlMode, ControlState, Packet, Region, Scan, ScopeState, ScopeStatus
from afspm.plugins.replay import replay as replay_module
from afspm.plugins.replay.replay import ReplayOptions, _addresses, replay
from afspm.record.store import RecordSettings, RecordStore
from afspm.supervisor import resume
from afspm.transport.network import is_local

START_NS = 1_773_518_400_000_000_000
STEP_NS = 60_000_000_000  # experiment time between two packets
SCANS = 30


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of half an hour, with a scan every minute."""
    folder = tmp_path_factory.mktemp("recorded")
    store = RecordStore(folder, RecordSettings({"experiment": "night", "simulated": True, "frame": "tip"}))
    things: list[tuple[str, object]] = [
        ("ControlState", ControlState(ControlMode.AUTOMATED, "series", ())),
        ("ScopeStateMsg", ScopeStatus(ScopeState.FREE)),
    ]
    for number in range(SCANS):
        values = np.full((4, 4), float(number))
        scan = Scan(Region((0, 0), (1e-6, 1e-6)), "Height", "m", values, START_NS + number, f"{number}.nc")
        things.append(("Scan2d_1000.0_Height", scan))
    packets = [
        Packet(envelope, wire.encode(thing)[1], START_NS + number * STEP_NS)
        for number, (envelope, thing) in enumerate(things)
    ]
    store.take((packet, "") for packet in packets)
    store.flush()
    store.close()
    (folder / "run.json").write_text(json.dumps({"name": "night", "clock": {"speed": 600.0}}), encoding="utf-8")
    return folder


@pytest.fixture
def replaying(recorded: Path, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A replay that has printed its address, at ten scans a second."""
    command = [sys.executable, "-m", "afspm", "replay", str(recorded), "--stay"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8"
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    assert "at 600 experiment seconds a second" in line
    yield process
    process.kill()
    process.stdout.close()
    process.wait()


def test_notebook_joins_a_replay_and_its_requests_are_refused(
    replaying: subprocess.Popen[str], recorded: Path, tmp_path: Path
) -> None:
    with afspm.open_run(recorded) as run:
        published = {(packet.envelope, packet.time_ns): bytes(packet.payload) for packet in run.packets()}
    with afspm.connect(tmp_path / "runs") as scope:
        seen = []
        for event in scope.events("Scan2d", timeout_s=DEADLINE_S):
            seen.append(event)
            if event.message.values[0, 0] == SCANS - 1:
                break
        assert scope.control_state is not None
        assert scope.control_state.holder == "series"
        times = [event.time_ns for event in seen if event.time_ns is not None]
        assert len(times) == len(seen)
        assert times == sorted(times)
        assert all((event.envelope, event.time_ns) in published for event in seen)
        with pytest.raises(RequestError, match="this is a replay"):
            scope.flag("thermal-drift")
        with pytest.raises(RequestError, match="this is a replay"):
            scope.action("start-scan")
    with afspm.connect(tmp_path / "runs", "late") as late:  # who joins late gets what was kept
        assert late.control_state is not None
        assert late.control_state.holder == "series"


def test_replay_ends_like_an_experiment_and_records_it(recorded: Path, tmp_path: Path) -> None:
    told: list[str] = []
    options = ReplayOptions(speed=1e6, only=["Scan2d"], runs=tmp_path / "runs")
    assert replay(recorded, options, told.append) == SCANS
    assert "1e+06 experiment seconds a second" in told[0]
    (folder,) = (tmp_path / "runs").glob("replay-*")
    facts = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert (facts["replay_of"], facts["ended"]) == (str(recorded), "the replay is over")
    assert afspm.open_run(tmp_path / "runs").folder == recorded, "the newest is a replay: what it replays is meant"
    with pytest.raises(ConfigError, match="this is a replay"):
        resume.find(folder)


TERMINATE = pytest.param(
    subprocess.Popen.terminate, marks=pytest.mark.skipif(WINDOWS, reason="there that is a kill"), id="terminate"
)


@pytest.mark.parametrize("stop", [pytest.param(interrupt, marks=can_interrupt), TERMINATE])
def test_stopped_replay_records_and_publishes_its_end(
    replaying: subprocess.Popen[str], tmp_path: Path, stop: Callable[[subprocess.Popen[str]], None]
) -> None:
    (folder,) = (tmp_path / "runs").glob("replay-*")
    with Follower(folder) as follower:
        follower.catch_up()
        stop(replaying)
        assert replaying.wait(DEADLINE_S) == 0
        assert json.loads((folder / "run.json").read_text(encoding="utf-8"))["ended"] == "the replay is over"
        until_s = follower.clock.monotonic_s() + 20.0
        while not follower.ended:
            assert follower.clock.monotonic_s() < until_s
            follower.pump(1.0)


def test_address_that_is_taken_leaves_no_folder(recorded: Path, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        options = ReplayOptions(publish=f"tcp://127.0.0.1:{taken.getsockname()[1]}", runs=tmp_path / "runs")
        with pytest.raises(TransportError):
            replay(recorded, options, lambda _: None)
    assert not (tmp_path / "runs").exists()


def test_unreplayable_run_is_refused(recorded: Path, tmp_path: Path) -> None:
    for only, said in ((["Scan3d"], "no message 'Scan3d'"), (["Spec1d"], "nothing to replay")):
        with pytest.raises(ConfigError, match=said):
            replay(recorded, ReplayOptions(only=only, runs=tmp_path), lambda _: None)


def test_replay_imports_no_module_that_the_recorded_run_names(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "beside_the_run.py").write_text("raise SystemExit('it was run')\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(replay_module, "_guest", lambda run: Launch("guest", messages=("beside_the_run",)))
    options = ReplayOptions(speed=1e9, only=["ControlState"], runs=tmp_path / "runs")
    assert replay(recorded, options, lambda _: None) == 1


def experiment_at(recorded: Path, publish: str, serve: str) -> Path:
    file = recorded / "experiment.toml"
    file.write_text(
        f'[scheduler]\ncomponent = true\nclass = "Scheduler"\npubsubcache = "{publish}"\nrouter = "{serve}"\n',
        encoding="utf-8",
    )
    return file


def test_replay_uses_the_addresses_of_the_experiment_file(recorded: Path, tmp_path: Path) -> None:
    file = experiment_at(recorded, "tcp://127.0.0.1:19471", "tcp://127.0.0.1:19472")
    with afspm.open_run(recorded) as run:
        assert _addresses(run, ReplayOptions()) == ("tcp://127.0.0.1:19471", "tcp://127.0.0.1:19472")
        assert _addresses(run, ReplayOptions(publish="tcp://127.0.0.1:1", serve="tcp://127.0.0.1:2")) == (
            "tcp://127.0.0.1:1",
            "tcp://127.0.0.1:2",
        )
    file.unlink()


def test_replay_of_a_run_on_several_computers_takes_addresses_of_this_computer(recorded: Path) -> None:
    file = experiment_at(recorded, "tcp://192.168.1.20:19471", "tcp://microscope:19472")
    with afspm.open_run(recorded) as run:
        assert all(map(is_local, _addresses(run, ReplayOptions())))
    file.unlink()
