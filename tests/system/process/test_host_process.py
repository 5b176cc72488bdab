"""The host, as a process: its start, its log, its end."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from afspm.basics.clock import ExperimentClock
from afspm.basics.exit_codes import ExitCode
from afspm.basics.launch import Launch, Sockets
from afspm.supervisor.hosting import MOST_FILES
from afspm.transport.heartbeat import Heartbeat, HeartbeatListener

Host = Callable[[Launch], Any]
CLOCK = ExperimentClock.real()


def part(name: str, **launch: Any) -> Launch:
    return Launch(name.lower(), f"process_parts.{name}", **launch)


def test_component_ends_cleanly_when_its_parent_lets_go(host: Host) -> None:
    child = host(part("Diary"))
    child.expect("start")
    child.let_go()
    child.expect("end")
    assert child.exit_code() == ExitCode.ORPHAN
    assert child.error_text == ""


@pytest.mark.parametrize("name", ["Stuck", "Stubborn"])
def test_process_that_does_not_end_by_itself_is_ended(host: Host, name: str) -> None:
    child = host(part(name))
    child.expect("st")
    child.let_go()
    assert child.exit_code() == ExitCode.ORPHAN


@pytest.mark.skipif(sys.platform == "win32", reason="signals of Unix")
def test_ctrl_c_in_the_terminal_is_left_to_the_parent(host: Host) -> None:
    child = host(part("Diary"))
    child.expect("start")
    child.popen.send_signal(signal.SIGINT)
    child.let_go()
    assert child.exit_code() == ExitCode.ORPHAN
    child.expect("end")


@pytest.mark.skipif(sys.platform == "win32", reason="signals of Unix")
def test_sigterm_ends_a_component_cleanly(host: Host) -> None:
    child = host(part("Diary"))
    child.expect("start")
    child.popen.terminate()
    child.expect("end")
    assert child.exit_code() == ExitCode.ORPHAN


@pytest.mark.skipif(sys.platform == "win32", reason="signals of Unix")
def test_sigterm_right_before_a_wait_ends_it(host: Host) -> None:
    child = host(part("SignalledElsewhere"))
    child.expect("start")
    child.expect("end")
    assert child.exit_code() == ExitCode.ORPHAN


@pytest.mark.skipif(sys.platform != "linux", reason="asking for another's limits")
def test_a_process_may_have_as_many_connections_as_the_system_allows(host: Host) -> None:
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_FILES if hard == resource.RLIM_INFINITY else min(MOST_FILES, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most // 2, hard))
    try:
        child = host(part("Diary"))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    child.expect("start")
    assert resource.prlimit(child.popen.pid, resource.RLIMIT_NOFILE)[0] == most


@pytest.mark.parametrize(
    ("launch", "said"),
    [
        (Launch("x", "process_parts.Dairy"), "did you mean 'Diary'"),
        (Launch("x", "no_such_module.Diary"), "can't be imported"),
        (Launch("x", "Diary"), "names no class"),
        (Launch("x", "process_parts.Path"), "can't be run"),
        (part("NeedsThreshold"), "it takes threshold"),
        (part("NeedsThreshold", settings={"treshold": 1}), "it takes threshold"),
        (part("Diary", messages=("no_such_messages",)), "can't be imported"),
        (part("Diary", messages=("json",)), "no message types"),
        (part("Diary", problems={"x": 3}), "can't have the number 3"),
    ],
)
def test_settings_that_can_not_work_are_reported_and_not_tried_again(host: Host, launch: Launch, said: str) -> None:
    child = host(launch)
    assert child.exit_code() == ExitCode.CONFIG
    assert said in child.error_text
    assert child.error_text.startswith("ERROR ")
    assert "Traceback" not in child.error_text


@pytest.mark.parametrize("line", ["", "{", "5", '{"name": "x", "setings": {}}'])
def test_malformed_launch_line_is_reported(start: Any, line: str) -> None:
    child = start([sys.executable, "-m", "afspm.supervisor.host"], line)
    assert child.exit_code() == ExitCode.CONFIG
    assert child.error_text.startswith("ERROR ")


def test_error_is_logged_with_traceback_and_restarted(host: Host) -> None:
    child = host(part("Broken"))
    assert child.exit_code() == ExitCode.CRASHED
    first, *more = child.error_text.splitlines()
    assert first == "ERROR ZeroDivisionError: the tip"
    assert any("in on_start" in line for line in more)
    assert all(line.startswith("  ") for line in more)


def test_standard_input_is_hidden_from_the_component(host: Host) -> None:
    child = host(part("ReadsStdin"))
    child.expect("read ''")
    assert child.exit_code() == ExitCode.DONE
    assert child.error_text == "WARNING two\n  lines\n"


@pytest.fixture
def listener() -> Iterator[HeartbeatListener]:
    made = HeartbeatListener()
    yield made
    made.close()


def beats_until(listener: HeartbeatListener, enough: Callable[[Heartbeat], bool]) -> list[Heartbeat]:
    """Return the heartbeats up to one that is enough."""
    beats: list[Heartbeat] = []
    end_s = CLOCK.monotonic_s() + 20.0
    while CLOCK.monotonic_s() < end_s:
        for beat in listener.poll(end_s - CLOCK.monotonic_s()):
            beats.append(beat)
            if enough(beat):
                return beats
    raise AssertionError(f"not in {beats}")


def test_heartbeats_distinguish_busy_idle_and_closing(host: Host, listener: HeartbeatListener) -> None:
    address = listener.listen("diary")[0]
    child = host(part("Diary", beat_period_s=0.05, sockets=Sockets(heartbeat=address)))
    child.expect("start")
    beats_until(listener, lambda beat: beat.step_age_s == 0.0)
    child.let_go()
    beats_until(listener, lambda beat: beat.closing)


def test_busy_component_sends_age_and_limit_of_its_step(host: Host, listener: HeartbeatListener) -> None:
    address = listener.listen("stuck")[0]
    host(part("Stuck", beat_period_s=0.05, sockets=Sockets(heartbeat=address)))
    beats_until(listener, lambda beat: (beat.step_age_s or 0.0) > 0.3 and beat.longest_step_s == 12.5)


def test_slow_constructor_does_not_count_as_frozen(host: Host, listener: HeartbeatListener) -> None:
    """The limit of the class is unknown before the class is imported."""
    address = listener.listen("slow")[0]
    host(part("SlowToMake", beat_period_s=0.05, sockets=Sockets(heartbeat=address)))
    beats_until(listener, lambda beat: (beat.step_age_s or 0.0) > 0.1 and beat.longest_step_s == 300.0)


def test_step_that_takes_too_long_is_logged_with_its_line_of_code(host: Host, listener: HeartbeatListener) -> None:
    address = listener.listen("hanging")[0]
    child = host(part("Hanging", beat_period_s=0.05, sockets=Sockets(heartbeat=address)))
    # not while it is loaded, which may take longer
    beats_until(listener, lambda beat: beat.longest_step_s == 0.2 and (beat.step_age_s or 0.0) > 0.2)
    child.let_go()
    child.exit_code()
    assert child.error_text.startswith("ERROR a step takes longer than longest_step_s = 0.2 s")
    assert "threading.Event().wait(0.001)" in child.error_text
    assert "loop.py" not in child.error_text


def test_crash_sends_no_closing_heartbeat(host: Host, listener: HeartbeatListener) -> None:
    address = listener.listen("broken")[0]
    child = host(part("Broken", beat_period_s=0.05, sockets=Sockets(heartbeat=address)))
    assert child.exit_code() == ExitCode.CRASHED
    assert not any(beat.closing for beat in listener.poll(0.3))


def test_users_messages_come_from_a_proto_file(host: Host, tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    proto = tmp_path / "my-peaks.proto"
    proto.write_text('syntax = "proto3";\nmessage PeakList { repeated double heights = 1; }\n')
    child = host(part("Peaks", messages=(str(proto),)))
    child.expect("PeakList 2")
    assert child.exit_code() == ExitCode.DONE


def test_proto_file_with_errors_is_reported(host: Host, tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    proto = tmp_path / "peaks.proto"
    proto.write_text("message {")
    child = host(part("Diary", messages=(str(proto),)))
    assert child.exit_code() == ExitCode.CONFIG
    assert "has errors" in child.error_text
