"""An agent server with its real tools, before the scheduler and the microscope of `GrantRig`, on simulated time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

from fake_clock import FakeClock
from tests.simulation import grant_rig
from tests.simulation.grant_rig import STOP, GrantRig

from afspm import wire
from afspm.model import STOPPED_BY_AGENT, Frame, Packet, ProblemNames
from afspm.plugins.web.archive import Archive
from afspm.plugins.web.gateway.measurements import Measurements
from afspm.plugins.web.person_commands import PersonCommands
from afspm.plugins.web.watch import Bell, Watch
from afspm_agents.preflight import Preflight
from afspm_agents.tools import AgentTools
from afspm_agents.workplace import Workplace

T = TypeVar("T")
EXPERIMENT = Path(grant_rig.__file__).parents[2] / "experiments" / "agent"
"""Read only, for its limits."""


class _PatientWatch(Watch):
    """Waits by moving the clock."""

    def wait_for(self, condition: Any, within_s: float) -> bool:
        if condition(self.overview):
            return True
        self.clock.t_s += min(within_s, 5.0)  # type: ignore[attr-defined]
        return False


class _PatientBell(Bell):
    """Waits by moving the clock."""

    def __init__(self, clock: FakeClock) -> None:
        super().__init__()
        self._clock = clock

    async def wait(self, timeout_s: float) -> bool:
        self._clock.t_s += timeout_s
        await asyncio.sleep(0)
        return False


class _NoPreflight(Preflight):
    """The simulated run is tested apart: here it takes no time."""

    async def of(self, plan: Any, place: Any, who: str) -> Any:
        return {"seconds": 1.0, "harm": {}, "refusals": []}, None


class AgentRig(GrantRig):
    """The whole. Everything follows from the seed and the calls."""

    def prepare(self) -> None:
        self.watch = _PatientWatch(self.clock, ProblemNames({STOPPED_BY_AGENT: STOP}))
        measurements = Measurements(None, self.watch, self.clock.monotonic_s)
        self.place = Workplace(
            self.watch, _PatientBell(self.clock), Archive(None), measurements, self, Frame.TIP,
            experiment="rig", simulated=True, run_dir=EXPERIMENT,
        )  # fmt: skip
        self.twin = _NoPreflight()
        self.tools = AgentTools(self.place, self.twin, "claude")

    # --- Requests, for the workplace ---

    def name_of(self, person: str) -> str:
        return f"agent:{person}"

    def submit(self, person: str, action: Callable[[PersonCommands], T]) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(action(PersonCommands(self.link(self.name_of(person)), self.watch)))
        except BaseException as error:  # as a thread's future: the caller gets it
            future.set_exception(error)
        return future

    def on_published(self, packet: Packet) -> None:
        name = wire.message_of(packet.envelope)
        thing = wire.decode(name, packet.payload)
        self.place.take(thing, packet.time_ns or 0)
        self.watch.take(name, thing, packet.time_ns or 0, packet.envelope)


def run(coroutine: Any) -> Any:
    return asyncio.run(coroutine)
