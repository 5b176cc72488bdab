"""A translator with the faults that are not the controller's: late, lost and missing answers, hanging, dying."""

from __future__ import annotations

import logging
import os
import threading

from afspm.exit_codes import ExitCode
from afspm.microscopes.simulator.faults import Fault, Faults
from afspm.model import Response
from afspm.translator.translator import Translator


class FaultyTranslator(Translator):
    """`Translator` with the faults that its simulated microscope is told to have."""

    _late: tuple[float, Response] | None = None

    @property
    def _faults(self) -> Faults | None:
        return getattr(self.driver, "faults", None)

    def look(self) -> None:
        if self._late is not None and self._clock.monotonic_s() >= self._late[0]:
            response, self._late = self._late[1], None
            super().reply(response)
        faults = self._faults
        while faults is not None and (fault := faults.due(self._clock.now_s())) is not None:
            self._go_wrong(fault)
        super().look()

    def wait_s(self) -> float:
        wait_s = super().wait_s()
        if self._late is not None:
            wait_s = min(wait_s, self._late[0] - self._clock.monotonic_s())
        at_s = self._faults.next_s() if self._faults is not None else None
        if at_s is not None:
            wait_s = min(wait_s, self._clock.real_s(at_s - self._clock.now_s()))
        return max(0.0, wait_s)

    def _go_wrong(self, fault: Fault) -> None:
        self._log.warning("a simulated fault: %s", fault)
        self.state.save()
        if fault.kind == "crash":
            os._exit(ExitCode.CRASHED)
        if fault.kind == "hang":
            threading.Event().wait(fault.duration_s)

    def reply(self, response: Response, level: int = logging.INFO) -> None:
        faults = self._faults
        if faults is not None and faults.strikes("lose") is not None:
            self._log.warning("a simulated fault: the answer %s is lost", response)
            self._port.reply(None)
        elif faults is not None and (delay_s := faults.strikes("slow")) is not None:
            self._late = (self._clock.monotonic_s() + delay_s, response)
        else:
            super().reply(response, level)
