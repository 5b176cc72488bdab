"""Emulated controllers as processes: alone from the command line, and as part of an experiment."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq
from deadlines import DEADLINE_S
from makers import MAKERS
from systems import can_interrupt, interrupt

from afspm.basics.clock import ExperimentClock
from afspm.basics.exit_codes import ExitCode
from afspm.basics.launch import Launch, Sockets

HERE = Path(__file__).parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(HERE), "PYTHONUNBUFFERED": "1"}
WORDS = " listens at "


@contextmanager
def started(*arguments: str, cwd: Path) -> Iterator[subprocess.Popen[str]]:
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-m", *arguments],
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
        encoding="utf-8",
        cwd=cwd,
        env=ENVIRONMENT,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def ask(address: str, line: str) -> str:
    host, port = address.rsplit(":", 1)
    with socket.create_connection((host, int(port)), timeout=DEADLINE_S) as client:
        client.sendall(line.encode())
        return client.recv(1000).decode()


@can_interrupt
def test_emulate_prints_its_address_and_ends_on_ctrl_c(tmp_path: Path) -> None:
    arguments = ("afspm", "emulate", "echo.Echo", "greeting=good day", "--port", "0", "--seed", "7", "-o", "files")
    with started(*arguments, cwd=tmp_path) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("SIMULATED Echo controller: listening at 127.0.0.1:")
        assert str(tmp_path / "files") in line
        assert ask(line.split(" at ")[1].split(",")[0], "x") == "good day x, seed 7"
        interrupt(process)
        assert process.wait(DEADLINE_S) == 0
    assert (tmp_path / "files").is_dir()


def test_crash_on_the_command_line_ends_with_1(tmp_path: Path) -> None:
    with started("afspm", "emulate", "echo.Echo", "--port", "0", "--fault", "crash", cwd=tmp_path) as process:
        assert process.stdout is not None
        assert ask(process.stdout.readline().split(" at ")[1].split(",")[0], "x") == ""
        assert process.wait(DEADLINE_S) == 1


@pytest.mark.parametrize("vendor", sorted(MAKERS))
def test_taken_port_is_reported_in_one_sentence(vendor: str, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        with started("afspm", "emulate", vendor, "--port", port, cwd=tmp_path) as process:
            told = process.communicate(timeout=2 * DEADLINE_S)
    assert process.returncode == 1
    said = "".join(filter(None, told)).strip()
    assert f"another program listens at port {port}" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("vendor", "setting", "reason"),
    [
        ("nanonis", "range_m=2.6 V", "[nanonis] range_m = '2.6 V': V can't be converted to m (a length, for example"),
        ("nanonis", "range_m=-1 um", "'-1 um' is not above 0 m"),
        ("nanonis", "rage_m=1 um", "[nanonis] has no setting 'rage_m' (did you mean 'range_m'?)"),
        ("nanonis", "ports=two", "[nanonis] ports is a whole number, not 'two'"),
        ("nanonis", "logger_port=70000", "logger_port = 70000: this is not a port (0 to 65535)"),
        ("gxsm", "reach_m=400", "reach_m = 400: without a unit this means 400 m"),
        ("gxsm", "reach_m=-2 um", "'-2 um' is not above 0 m"),
        ("park", "start_s=soon", "start_s = 'soon': 'soon' is not a number with a unit"),
        ("park", "noise.current_a=1 pV", "noise.current_a: pV can't be converted to A"),
        ("asylum", "clock_off_s=2 um", "um can't be converted to s"),
        ("asylum", "idle_s=-5 ms", "'-5 ms' is below 0 s"),
        ("nanosurf", "release=new", "[nanosurf] release is a whole number, not 'new'"),
        ("nanosurf", "tip.radius_m=-8 nm", "is not above zero"),
    ],
)
def test_impossible_setting_is_refused_before_listening(vendor: str, setting: str, reason: str, tmp_path: Path) -> None:
    # results T7
    with started("afspm", "emulate", vendor, setting, cwd=tmp_path) as process:
        out, err = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, out) == (1, "")
    assert reason in err


@pytest.mark.parametrize("vendor", sorted(MAKERS))
def test_seed_and_quantities_are_settings_of_every_emulator(vendor: str, tmp_path: Path) -> None:
    # results T7
    given = ("seed=7", "tip.radius_m=8 nm", "clock_off_s=1 min", "drift.velocity_m_per_s=['15 pm/s', 0, 0]")
    with started("afspm", "emulate", vendor, *given, "-o", "files", cwd=tmp_path) as process:
        assert process.stdout is not None
        assert "listening" in process.stdout.readline()
    begun = json.loads((tmp_path / "files" / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0])
    assert begun["seed"] == 7
    assert begun["settings"]["tip"]["radius_m"] == "8 nm"


def test_option_given_as_a_setting_too_is_refused(tmp_path: Path) -> None:
    with started("afspm", "emulate", "echo.Echo", "--seed", "3", "seed=7", cwd=tmp_path) as process:
        out, err = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, out) == (1, "")
    assert "seed is given as an option and as a setting" in err


def test_quantity_on_the_command_line_has_a_unit(tmp_path: Path) -> None:
    with started("afspm", "emulate", "echo.Echo", "clock_off_s=-2 min", "-o", "files", cwd=tmp_path) as process:
        assert process.stdout is not None
        assert "listening" in process.stdout.readline()
    start, clock, *_ = map(json.loads, (tmp_path / "files" / "truth.jsonl").read_text(encoding="utf-8").splitlines())
    assert (start["event"], clock["event"], clock["off_s"]) == ("start", "clock of the controller", -120.0)


def test_unknown_fault_is_refused_before_listening(tmp_path: Path) -> None:
    with started("afspm", "emulate", "echo.Echo", "--fault", "crush", cwd=tmp_path) as process:
        out, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 1
    assert out == ""
    assert "did you mean 'crash'?" in err


def launched(settings: dict[str, object], subscribe: str, run_dir: Path, class_: str) -> str:
    launch = Launch(
        name="controller",
        class_=class_,
        settings={"port": 0, **settings},
        sockets=Sockets(subscribe=(subscribe,)),
        envelopes=(),
        clock=ExperimentClock.starting_now(0.0, speed=60.0).as_dict(),
        run_dir=str(run_dir),
    )
    return launch.to_json() + "\n"


@contextmanager
def beginning(
    settings: dict[str, object], tmp_path: Path, class_: str = "echo.Echo"
) -> Iterator[tuple[subprocess.Popen[str], zmq.Socket[bytes]]]:
    """Start the process with its launch line; yield it with the scheduler that it subscribes to."""
    with zmq.Context() as context, context.socket(zmq.XPUB) as scheduler:
        scheduler.setsockopt(zmq.LINGER, 0)
        port = scheduler.bind_to_random_port("tcp://127.0.0.1")
        with started("afspm.supervisor.host", cwd=tmp_path) as process:
            assert process.stdin is not None
            process.stdin.write(launched(settings, f"tcp://127.0.0.1:{port}", tmp_path, class_))
            process.stdin.flush()
            yield process, scheduler


@contextmanager
def in_an_experiment(
    settings: dict[str, object], tmp_path: Path
) -> Iterator[tuple[subprocess.Popen[str], str, zmq.Socket[bytes]]]:
    with beginning(settings, tmp_path) as (process, scheduler):
        assert process.stderr is not None
        line = process.stderr.readline()
        assert line.startswith("WARNING SIMULATED: an emulated Echo controller"), line
        yield process, line.split(WORDS)[1].strip(), scheduler


def test_end_of_the_experiment_before_listening_ends_the_emulator(tmp_path: Path) -> None:
    with beginning({}, tmp_path, "echo.Late") as (process, scheduler):
        assert scheduler.poll(int(DEADLINE_S * 1000))
        scheduler.send(b"KILL")
        assert process.wait(DEADLINE_S) == ExitCode.ENDED
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()


def test_emulator_in_an_experiment_uses_its_clock_and_ends_with_it(tmp_path: Path) -> None:
    with in_an_experiment({"greeting": "hello"}, tmp_path) as (process, address, scheduler):
        assert ask(address, "x") == "hello x, seed 1"
        assert 0.0 < float(ask(address, "time")) < 3600.0
        assert (tmp_path / "controller").is_dir()
        assert scheduler.poll(int(DEADLINE_S * 1000))  # it has subscribed
        scheduler.send(b"KILL")
        assert process.wait(DEADLINE_S) == ExitCode.ENDED


def test_emulator_in_an_experiment_ends_with_its_parent(tmp_path: Path) -> None:
    with in_an_experiment({}, tmp_path) as (process, _, _):
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(DEADLINE_S) == ExitCode.ORPHAN


def test_crash_in_an_experiment_has_its_exit_code(tmp_path: Path) -> None:
    with in_an_experiment({"faults": ["crash"]}, tmp_path) as (process, address, _):
        assert ask(address, "x") == ""
        assert process.wait(DEADLINE_S) == ExitCode.CRASHED
