"""A process for tests of the supervisor: it sends heartbeats, and behaves as its settings say."""

from __future__ import annotations

import ctypes
import os
import socket
import sys
import threading
import time
from pathlib import Path

from afspm.basics.clock import ExperimentClock
from afspm.basics.launch import Launch
from afspm.transport.heartbeat import HeartbeatSender


def main() -> int:
    launch = Launch.from_json(sys.stdin.readline())
    settings = launch.settings
    clock = ExperimentClock.real()
    began_s = clock.monotonic_s()
    busy, beats_sent = threading.Event(), threading.Semaphore(0)

    def step_age_s() -> float:
        beats_sent.release()
        return clock.monotonic_s() - began_s if busy.is_set() else 0.0

    if settings.get("first") == "load":
        busy.set()  # before the first heartbeat
    assert launch.sockets.heartbeat
    beats = HeartbeatSender(
        launch.sockets.heartbeat,
        launch.beat_period_s,
        step_age_s,
        lambda: float(settings.get("longest_step_s", 30.0)),
        launch.beat_token,
    )
    if port := settings.get("call"):  # open as long as we live
        call = socket.create_connection(("127.0.0.1", port))
        call.sendall(b"%d\n" % os.getpid())
    lives = _count(Path(settings["lives"])) if "lives" in settings else 1
    say(f"life {lives}")
    match settings.get("first", "") if lives == 1 else settings.get("then", "wait"):
        case "crash":
            sys.stderr.write("ERROR it breaks\n")
            os._exit(1)
        case "quit":  # as a process of version 1 that has caught its own error
            os._exit(0)
        case "busy":
            busy.set()
            threading.Event().wait(float(settings["busy_s"]))
            busy.clear()
            say("no longer busy")
        case "load":
            wait_for_a_beat(beats, beats_sent)
            say("loads for ever")
        case "deaf":
            threading.Event().wait()
        case "grip":  # one call into C that holds Python's lock: no other thread has its turn
            busy.set()
            wait_for_a_beat(beats, beats_sent)
            grip(float(settings["busy_s"]))
            busy.clear()
            say("has let go")
        case "stuck":  # the same, and waits there
            wait_for_a_beat(beats, beats_sent)
            if sys.platform == "win32":
                ctypes.PyDLL("kernel32").Sleep(-1)
            else:
                ctypes.PyDLL(None).pause()
        case "exit":
            beats.close()
            return int(settings["code"])
    sys.stdin.read()
    beats.close()
    return 81


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def wait_for_a_beat(beats: HeartbeatSender, beats_sent: threading.Semaphore) -> None:
    """Wait for two heartbeats: the first has been sent when the second is made."""
    beats.heard.wait()
    while beats_sent.acquire(blocking=False):
        pass
    beats_sent.acquire()
    beats_sent.acquire()


def grip(for_s: float) -> None:
    """Compute in one call for a span of processor time."""
    began_s = time.process_time()
    sum(range(10**6))
    say("holds on")
    sum(range(round(10**6 * for_s / (time.process_time() - began_s))))


def _count(file: Path) -> int:
    count = int(file.read_text()) + 1 if file.exists() else 1
    file.write_text(str(count))
    return count


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)
