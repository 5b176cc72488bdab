"""The safe end of a run: the measurement is stopped, and a tip without feedback is retracted."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable

from afspm.basics.clock import Clock
from afspm.model import Response, ScopeState, names
from afspm.translator.commands import ASIDE
from afspm.translator.connection import RETRY_S, Connection
from afspm.translator.driver_base import LOST
from afspm.translator.state import TranslatorState
from afspm.translator.temporary_settings import TemporarySettings

_STEP_S = 0.02  # real time between steps of the way back of a held z
_LOOK_S = 0.1  # real time between looks whether the tip moves
_TIP_S = 8.0
"""Real time for attempts to retract the tip when the run is stopped: the controller may be lost just then, or refuse. A
little less than `transport.process.parent` allows."""


class SafeExit:
    """The end of a run: stops the running measurement, and retracts a tip left without feedback.

    Args:
        retracts: True to retract the tip when a request has switched the feedback off and no process is left to switch
            the feedback on again.
        act: executes an action of the translator itself.
        observe: publishes all changes.
    """

    def __init__(
        self,
        connection: Connection,
        state: TranslatorState,
        temporary: TemporarySettings,
        clock: Clock,
        log: logging.Logger,
        *,
        retracts: bool,
        act: Callable[[str], Response],
        observe: Callable[[], None],
    ) -> None:
        self._connection = connection
        self._state = state
        self._temporary = temporary
        self._clock = clock
        self._log = log
        self._retracts = retracts
        self._act = act
        self._observe = observe
        self._is_sent_aside = False

    def is_owed(self) -> bool:
        """Return whether the tip must be retracted before the process ends. Thread-safe."""
        return self._retracts and self._state.feedback.in_danger

    def end(self) -> None:
        """Stop measuring and restore temporary settings, on the scheduler's request; ignore a lost controller."""
        with contextlib.suppress(*LOST):  # the process ends in any case
            self._stop_measuring()
            self._temporary.end()

    def leave(self, wait: Callable[[float], None]) -> None:
        """Stop measuring, restore temporary settings, and retract the tip if `is_owed`.

        A feedback switched off at the panel stays off. Attempts to retract are repeated for a few real seconds.

        Args:
            wait: waits for a time in real seconds, and then polls the controller.
        """
        self._connection.guarded(self._stop_measuring)
        if self._connection.stands:
            self._connection.guarded(self._temporary.end)
        until_s = self._clock.monotonic_s() + _TIP_S
        # the height of a held z is known, and so is where the tip lands
        while self._connection.stands and self._temporary.held.is_ending and self._clock.monotonic_s() < until_s:
            wait(_STEP_S)
        # the feedback is not switched on instead: where the tip would land by then is not known (decision 0007)
        has_asked = False
        while has_asked or self.is_owed():
            is_off = has_asked or self._state.feedback.is_off
            why_not = self._retract_failure() if is_off else f"the controller is lost: {self._connection.why_lost}"
            if not why_not:
                has_asked = True
                why_not = self._motion_failure(wait, until_s)
            if not why_not:
                self._log.warning("the run is stopping with the feedback off: the tip was retracted")
                return
            if self._clock.monotonic_s() >= until_s:
                off = "off" if is_off else "perhaps off"
                so = "it is not certain that the tip was retracted" if has_asked else "the tip can't be retracted"
                self._log.critical("the run is stopping with the feedback %s, and %s: %s", off, so, why_not)
                return
            wait(RETRY_S)

    def _motion_failure(self, wait: Callable[[float], None], until_s: float) -> str:
        # a controller may not have read the command yet, and drops it when our connection closes
        sets_out = False
        while (state := self._state.sequence.published.state) is not ScopeState.FREE:
            sets_out = sets_out or state is ScopeState.COARSE_MOTOR
            if not self._connection.stands:
                if self._is_sent_aside:
                    return ""
                return f"the controller is lost: {self._connection.why_lost}"
            if sets_out and state is ScopeState.INTERRUPTED:
                return "the retract was interrupted"
            if self._clock.monotonic_s() >= until_s:
                return f"a retract was sent, and the state is still {state.name}"
            wait(_LOOK_S)
        return ""

    def _retract_failure(self) -> str:
        answered: list[Response] = []
        self._connection.guarded(lambda: answered.append(self._retract()))
        if not answered:
            return self._connection.why_lost
        response = answered[0]
        return "" if response.ok else response.reason or str(response.code)

    def _retract(self) -> Response:
        response = self._act(names.RETRACT)
        self._is_sent_aside = response.ok and response.reason == ASIDE
        self._state.save()
        return response

    def _stop_measuring(self) -> None:
        published = self._state.sequence.published.state
        stop = {ScopeState.SCANNING: names.STOP_SCAN, ScopeState.SPEC: names.STOP_SPEC}.get(published)
        if stop is not None and self._connection.stands:
            self._act(stop)
            self._observe()
            self._state.save()
