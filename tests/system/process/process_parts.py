"""Components for the tests of the host."""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path
from typing import Any

from afspm.client.component import Component
from afspm.model import Region, Scan


def say(*words: object) -> None:
    """Write to the test, which reads standard output."""
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


class Diary(Component):
    """A component that writes its calls to standard output."""

    def on_start(self) -> None:
        say("start")

    def on_end(self) -> None:
        say("end")


class SignalledElsewhere(Diary):
    """A component whose SIGTERM ends no wait of its main thread, like one that comes right before the wait."""

    def on_start(self) -> None:
        super().on_start()
        threading.Thread(target=self._terminate, args=(threading.get_ident(),), daemon=True).start()

    def _terminate(self, main: int) -> None:
        while "poll" not in sys._current_frames()[main].f_code.co_name:
            threading.Event().wait(0.001)
        signal.pthread_kill(threading.get_ident(), signal.SIGTERM)


class NeedsThreshold(Component):
    def __init__(self, threshold: float) -> None:
        self.threshold = threshold


class Stuck(Component):
    """A component that computes for ever and ignores interrupts."""

    longest_step_s = 12.5

    def on_start(self) -> None:
        say("stuck")
        while True:
            threading.Event().wait(0.001)


class SlowToMake(Component):
    """A component whose constructor takes long, as for loading the weights of a network."""

    def __init__(self) -> None:
        say("made")
        threading.Event().wait()


class Hanging(Stuck):
    """A component that computes for longer than its limit."""

    longest_step_s = 0.2


class Stubborn(Component):
    """A script that swallows every error."""

    def run(self) -> None:
        say("start")
        while True:
            try:
                self.scope.sleep(3600.0)
            except Exception:
                self.log.info("never mind")


class Broken(Component):
    def on_start(self) -> None:
        raise ZeroDivisionError("the tip\nis gone")


class ReadsStdin(Component):
    def run(self) -> None:
        say(f"read {sys.stdin.read()!r}")
        self.log.warning("two\nlines")


class EndsEverything(Component):
    def run(self) -> None:
        self.scope.end_experiment()
        self.scope.wait_until(lambda: False)


class Peaks(Component):
    """A component that publishes a user's message."""

    def run(self) -> None:
        from afspm import wire

        message: Any = wire.message_type("PeakList")()
        message.heights.extend([1.0, 2.0])
        say(message.DESCRIPTOR.name, len(message.heights))


class Survey(Component):
    """A component that takes three scans, each once."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def run(self) -> None:
        for i in range(3):
            region = Region((i * 2e-6, 0.0), (1e-6, 1e-6))
            scans = self.scope.scan(region, shape=(16, 16), key=f"tile-{i}")
            say(f"tile {i} {scans.region.center_m[0]:.1e}")
        say("all")

    def on_scan(self, scan: Scan) -> None:
        with (self.folder / "seen").open("a") as file:
            file.write(f"{scan.channel} {scan.region.center_m[0]:.1e} {scan.time_ns}\n")
