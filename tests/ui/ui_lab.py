"""Shared parts of the tests in a browser: an experiment with a dashboard, and a browser."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from afspm_process import AfspmProcess

from afspm import wire
from afspm.cli.follower import Follower
from afspm.model import ControlState, JournalEntry, LogLine, Role, ScopeState

Opened = Callable[..., Any]
DEADLINE_S = 240.0
"""As long is a page waited for: half of the deadline of other tests, so that a red test is sooner red."""
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
every = "{every}"
scans = 20
parameters = {{ scan-speed = "4 um/s" }}

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


FOR_ALL = """
[agent]
component = true
class = "Agent"
port = 0

[limits.roles.agent]
actions = ["start-scan", "start-spec"]
parameters = { tip-bias-voltage = ["-1 V", "1 V"], scan-speed = ["0.1 um/s", "50 um/s"] }
region = { x = ["-2 um", "2 um"], y = ["-2 um", "2 um"] }
per_hour = { start-scan = 30 }

[pump]
component = true
class = "pump.Pump"
"""
"""What some tests need in the night that all tests share."""
PUMP = """
from afspm import Component


class Pump(Component):
    period_s = 0.1
    period_time = "real"

    def on_tick(self):
        is_on = not (self.run_dir / "pump-off").exists()
        if is_on != self.memory.get("is_on", True):
            self.memory["is_on"] = is_on
            if is_on:
                self.log.info("the pump runs; no longer true: the pump is off")
            else:
                self.log.critical("the pump is off: <no current>")
"""


class Night(AfspmProcess):
    """`afspm run` of an experiment with a dashboard, as a process of its own."""

    def __init__(
        self,
        folder: Path,
        *,
        speed: float = 60.0,
        lines: float = 2.0,
        more: str = "",
        options: tuple[str, ...] = (),
        messages: tuple[str, ...] = (),
        every: str = "4 h",
    ) -> None:
        file = folder / "experiment.toml"
        own = f"messages = {[*messages]}\n"
        file.write_text(own + EXPERIMENT.format(speed=speed, lines=lines, every=every) + more, encoding="utf-8")
        super().__init__("run", str(file), "--runs", str(folder / "runs"), *options, folder=folder)
        try:
            self.url = self.wait_for_url("dashboard")
            published = [one.name for one in wire.declared() if one.source in (Role.TRANSLATOR, Role.SCHEDULER)]
            self.follower = Follower(self.folder, "terminal", tuple(published))
        except BaseException:  # also Ctrl-C must not leave the experiment running
            super().close()
            raise
        self.follower.catch_up()

    @property
    def state(self) -> ScopeState | None:
        """The state received last."""
        status = self.follower.overview.status
        return None if status is None else status.state

    def until(self, condition: Callable[[], object]) -> Any:
        """Receive the scheduler's messages until `condition()`; return its value."""
        end_s = time.monotonic() + DEADLINE_S
        while not (found := condition()):
            assert time.monotonic() < end_s, f"{condition} never came true"
            assert not self.follower.ended
            self.follower.pump(end_s - time.monotonic())
        return found

    def errors(self) -> list[LogLine]:
        """Return the log's lines of level ERROR so far."""
        self.follower.pump(0.0)
        return [line for line in self.follower.overview.log if line.level == "ERROR"]

    def control(self) -> ControlState:
        """The control state last published by the scheduler."""
        control = self.follower.overview.control
        assert control is not None
        return control

    def entry(self, who: str, what: str, *, after: int = 0) -> JournalEntry:
        """Return the newest journal entry of this name whose text contains `what`, from the `after`-th entry on."""

        def newest() -> JournalEntry | None:
            entries = list(self.follower.overview.entries)[after:]
            return next((one for one in reversed(entries) if one.who == who and what in one.what), None)

        entry: JournalEntry = self.until(newest)
        return entry

    def close(self) -> None:
        """End the experiment, also a broken one."""
        self.follower.close()
        self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(DEADLINE_S)
        super().close()
