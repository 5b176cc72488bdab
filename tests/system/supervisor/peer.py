"""A process for the tests of the supervisor: it beats as ours do, and behaves as its settings say."""

from __future__ import annotations

import os
import socket
import sys
import threading
from pathlib import Path

from afspm.clock import ExperimentClock
from afspm.runtime.launch import Launch
from afspm.transport.heartbeat import HeartbeatSender


def main() -> int:
    launch = Launch.from_json(sys.stdin.readline())
    settings = launch.settings
    clock = ExperimentClock.real()
    began_s = clock.monotonic_s()
    busy = threading.Event()
    assert launch.sockets.heartbeat
    beats = HeartbeatSender(
        launch.sockets.heartbeat,
        launch.beat_period_s,
        lambda: clock.monotonic_s() - began_s if busy.is_set() else 0.0,
        lambda: float(settings.get("longest_step_s", 30.0)),
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
        case "busy":
            busy.set()
            threading.Event().wait(float(settings["busy_s"]))
            busy.clear()
            say("no longer busy")
        case "deaf":
            threading.Event().wait()
        case "exit":
            beats.close()
            return int(settings["code"])
    sys.stdin.read()
    beats.close()
    return 81


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _count(file: Path) -> int:
    count = int(file.read_text()) + 1 if file.exists() else 1
    file.write_text(str(count))
    return count


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)
