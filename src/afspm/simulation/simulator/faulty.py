"""A translator with injected faults of its own: late and missing answers, hangs, crashes.

A module of its own, though only the driver imports it: it needs the translator with its sockets, and `afspm check` and
all processes that only read the file import the driver without them.
"""

from __future__ import annotations

import logging
import os
import threading
from typing import TYPE_CHECKING, cast

from afspm.basics.exit_codes import ExitCode
from afspm.model import Response
from afspm.simulation.faults import Fault
from afspm.translator.translator import Translator

if TYPE_CHECKING:
    from afspm.simulation.simulator import Simulator


class FaultyTranslator(Translator):
    """`Translator` with the faults of its simulated microscope."""

    _late: tuple[float, Response] | None = None

    @property
    def _simulator(self) -> Simulator:
        return cast("Simulator", self.driver)

    def look(self) -> None:
        if self._late is not None and self._clock.monotonic_s() >= self._late[0]:
            response, self._late = self._late[1], None
            super().reply(response)
        simulator = self._simulator
        # only now, so that the request that demands the fault is still answered
        if simulator.faults is not None and simulator.demanded is not None:
            simulator.faults.demand(simulator.demanded, self._clock.now_s())
            simulator.demanded = None
        if self._strikes("crash"):
            os._exit(ExitCode.CRASHED)
        hang = self._strikes("hang")
        if hang is not None:
            threading.Event().wait(hang.duration_s)
        super().look()

    def wait_s(self) -> float:
        wait_s = super().wait_s()
        if self._late is not None:
            wait_s = min(wait_s, self._late[0] - self._clock.monotonic_s())
        now_s, faults = self._clock.now_s(), self._simulator.faults
        at_s = None if faults is None else now_s if self._simulator.demanded else faults.next_s(now_s)
        if at_s is not None:
            wait_s = min(wait_s, self._clock.real_s(at_s - now_s))
        return max(0.0, wait_s)

    def _strikes(self, kind: str) -> Fault | None:
        faults = self._simulator.faults
        fault = None if faults is None else faults.strikes(kind, self._clock.now_s())
        if fault is not None:
            self._log.warning("a simulated fault: %s", fault)
            self.state.save()  # saved at once: a crash must not strike again after the restart
        return fault

    def reply(self, response: Response, level: int = logging.INFO) -> None:
        if self._strikes("no-reply"):
            self._log.warning("the answer %s is lost", response)
            self._port.reply(None)
        elif (late := self._strikes("late-reply")) is not None:
            self._late = (self._clock.monotonic_s() + late.duration_s, response)
        else:
            super().reply(response, level)
