"""What the tests in a browser share: an experiment that runs with a dashboard, and a browser that looks at it."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from afspm.client.follower import SMALL, Follower
from afspm.model import ControlState, JournalEntry

DEADLINE_S = 30.0
AFSPM = (sys.executable, "-c", "from afspm.cli import main; main()")
Opened = Callable[..., Any]
SCREENSHOTS = Path(__file__).parents[2] / "build" / "screenshots"

EXPERIMENT = """
[clock]
speed = {speed}

[microscope]
component = true
class = "Simulator"
seed = 4
surface = {{ kind = "particles" }}
initial = {{ scan-speed = "4 um/s" }}
live_lines_s = {lines}

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "0.6 um"]
center = ["0.3 um", "-0.2 um"]
pixels = [40, 64]
every = "4 h"
scans = 20

[control]
solved_by_hand = ["tip-shape-changed", "device-malfunction", "drop-on-the-table"]

adjustable = ["zctrl-setpoint", "zctrl-pgain"]

[problems]
drop-on-the-table = 9

[limits]
region = {{ x = ["-5 um", "5 um"], y = ["-5 um", "5 um"] }}

[limits.tip-bias-voltage]
max = "3 V"

[dashboard]
component = true
class = "Dashboard"
port = 0
"""


class Night:
    """`afspm run` of an experiment with a dashboard, as a process of its own."""

    def __init__(
        self, folder: Path, *, speed: float = 60.0, lines: float = 2.0, more: str = "", options: tuple[str, ...] = ()
    ) -> None:
        file = folder / "experiment.toml"
        file.write_text(EXPERIMENT.format(speed=speed, lines=lines) + more, encoding="utf-8")
        self._lines: list[str] = []
        self._changed = threading.Condition()
        self.process = subprocess.Popen(
            (*AFSPM, "run", str(file), "--runs", str(folder / "runs"), *options),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            start_new_session=True,
            cwd=folder,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        try:
            self.folder = Path(self.wait_for(r"processes, into (.+)")[1])
            self.url = self.wait_for(r"the dashboard is at (\S+)")[1]
            self.follower = Follower(self.folder, "terminal", (*SMALL, "Scan2d", "Spec1d", "ScanLines"))
        except BaseException:
            self._end()
            raise
        self.follower.catch_up()

    def wait_for(self, pattern: str) -> re.Match[str]:
        """The first line so far, or to come, that fits."""
        with self._changed:
            found = self._changed.wait_for(lambda: self._found(pattern), DEADLINE_S)
        assert found, f"no line like {pattern!r} in\n" + "\n".join(self._lines)
        return found

    def until(self, condition: Callable[[], object]) -> Any:
        """Follow what the scheduler publishes until `condition()`; what it then is."""
        end_s = time.monotonic() + DEADLINE_S
        while not (found := condition()):
            assert time.monotonic() < end_s, f"{condition} never came true"
            assert not self.follower.ended
            self.follower.pump(end_s - time.monotonic())
        return found

    def control(self) -> ControlState:
        """As the scheduler published it last."""
        control = self.follower.overview.control
        assert control is not None
        return control

    def entry(self, who: str, what: str, *, after: int = 0) -> JournalEntry:
        """The newest entry of the journal of this name whose words contain `what`, from the `after`-th entry on."""

        def newest() -> JournalEntry | None:
            entries = list(self.follower.overview.entries)[after:]
            return next((one for one in reversed(entries) if one.who == who and what in one.what), None)

        entry: JournalEntry = self.until(newest)
        return entry

    def close(self) -> None:
        """End it, however it is."""
        self.follower.close()
        self._end()

    def _end(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(20.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self._lines.append(line.rstrip())
                self._changed.notify_all()

    def _found(self, pattern: str) -> re.Match[str] | None:
        return next((match for line in self._lines if (match := re.search(pattern, line))), None)
