"""Requests of one person to the scheduler, which may refuse them; used by dashboard, gateway and agent server."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress

from afspm import wire
from afspm.basics import NoResponse
from afspm.client import FITS, ExperimentLink, Value, is_set, to_parameter
from afspm.model import (
    LEASE_REQUEST,
    RELAY_REQUEST,
    RESTART_REQUEST,
    XY,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Note,
    Parameter,
    ProbePosition,
    Region,
    RelayedMessage,
    Response,
    ScanParameters,
    ScopeState,
    names,
)
from afspm.night import Overview
from afspm.plugins.web.watch import Watch, is_free

ANSWER_S = 20.0  # real time for an answer
FREE_S = 60.0  # real time for the microscope to reach a place
AT_M = 5e-9  # a controller's rounding of the probe's position
SETTLED_S = 2.0  # a changed setting is published within this time


class PersonCommands:
    """The requests of one person, for use in one thread. Each returns the response, even a refusal.

    Args:
        hurried: whether an urgent action of this person waits for the end of the present one.
        meanwhile: actions of this person to carry out while the present one waits for a free microscope.
    """

    def __init__(
        self,
        link: ExperimentLink,
        watch: Watch,
        hurried: Callable[[], bool] = lambda: False,
        meanwhile: deque[Callable[[], None]] | None = None,
    ) -> None:
        self._link = link
        self._watch = watch
        self._hurried = hurried
        self._meanwhile = deque[Callable[[], None]]() if meanwhile is None else meanwhile
        self._lends = False

    # --- the experiment ---

    def request_control(self, problem: int = 0) -> Response:
        """Request control; `problem` is the number of the problem to solve, 0 for none."""
        return self._ask(ControlRequest.REQUEST_CTRL, problem)

    def renew(self, lease_s: float) -> Response:
        """Renew the lease: keep control for `lease_s` real seconds without another command or renewal."""
        return self._ask(LEASE_REQUEST, lease_s)

    def release_control(self) -> Response:
        """Give back what the person's measurements have lent, and release control."""
        if self._lends:
            with suppress(NoResponse):  # the scheduler sets it back before others measure
                self._link.give_back(self._link.until(ANSWER_S))
        return self._ask(ControlRequest.RELEASE_CTRL)

    def set_mode(self, mode: ControlMode) -> Response:
        return self._ask(ControlRequest.SET_CONTROL_MODE, int(mode))

    def end(self) -> Response:
        """End the experiment for everyone."""
        return self._ask(ControlRequest.END_EXPERIMENT)

    def flag(self, problem: int) -> Response:
        return self._ask(ControlRequest.ADD_EXP_PRBLM, problem)

    def clear(self, problem: int) -> Response:
        return self._ask(ControlRequest.RMV_EXP_PRBLM, problem)

    def settle_plan(self, parameter: str, *, keeps: bool) -> Response:
        """Let plans measure with the value set in MANUAL, or with their own."""
        return self._link.settle_plans([parameter], keeps=keeps, until_s=self._link.until(ANSWER_S))

    def restart(self, process: str) -> Response:
        return self._ask(RESTART_REQUEST, process)

    def note(self, text: str, scan_ns: int | None = None, time_ns: int | None = None) -> Response:
        """Write a note about a scan or a time, by default the present."""
        now_ns = self._link.clock.now_ns()
        about_ns = next(one for one in (time_ns, scan_ns, now_ns) if one is not None)
        note = Note(about_ns, self._link.name, text, scan_ns, now_ns)
        return self._ask(RELAY_REQUEST, RelayedMessage(*wire.encode(note)))

    # --- the microscope ---

    def get(self, parameter: str) -> Response:
        return self._ask(ControlRequest.PARAM, Parameter(parameter))

    def set(self, parameter: str, value: Value, unit: str | None = None) -> Response:
        """Set a parameter to a number, a quantity as text or a word."""
        return self._ask(ControlRequest.PARAM, to_parameter(parameter, value, unit))

    def supports(self, action: str) -> Response:
        return self._ask(ControlRequest.ACTION_SUPPORT, action)

    def act(self, action: str) -> Response:
        """Start an action of the microscope by its name."""
        return self._ask(ControlRequest.ACTION, action)

    def prepare_scan(self, region: Region | None, shape: tuple[int, int] | None) -> Response | None:
        """Set the region and shape of the next scan, wait for publication (2 s at most); return None or a refusal."""
        if region is None and shape is None:
            return None
        wanted = ScanParameters(region, shape)
        response = self._ask(ControlRequest.SET_SCAN_PARAMS, wanted)
        if not response.ok:
            return response
        self._settle(lambda o: is_set(wanted, o.readings.scan_parameters, FITS))
        return None

    def prepare_spectrum(self, at_m: XY | None) -> Response | None:
        """Move the probe to (x, y), wait for publication (2 s at most); return None or a refusal."""
        if at_m is None:
            return None
        response = self._ask(ControlRequest.SET_PROBE_POS, ProbePosition(at_m))
        if not response.ok:
            return response
        self._settle(
            lambda o: o.readings.probe_position is not None and math.dist(o.readings.probe_position.xy_m, at_m) <= AT_M
        )
        return None

    def act_when_free(
        self, action: str, next_id: Callable[[], str] = str, settings: Sequence[Parameter] = ()
    ) -> Response:
        """Request an action, and repeat the request while the microscope is busy, for `FREE_S` at most.

        The wait ends early for an urgent action of the same person, such as to stop the scan.

        Args:
            next_id: returns the id of the next attempt; requests with the same id are executed once. It is called once
                the settings are in force.
            settings: the settings of the measurement, stated before each attempt.
        """
        until_s = self._link.clock.monotonic_s() + FREE_S
        while True:
            self._wait_for(is_free, until_s)
            with self._watch.reading():
                seen = self._watch.changes
            response = self._lend(settings) or self._ask(ControlRequest.ACTION, action, next_id())
            is_over = self._hurried() or self._link.clock.monotonic_s() >= until_s
            if response.code != ControlResponse.NOT_FREE or is_over:
                return response
            self._wait_for(lambda _, n=seen: self._watch.changes != n, self._link.clock.monotonic_s() + 1.0)  # type: ignore[misc]

    def stop(self) -> Response:
        """Stop the running scan or spectrum."""
        return self.act(names.STOP_SPEC if self.measures_spectrum else names.STOP_SCAN)

    @property
    def measures_spectrum(self) -> bool:
        with self._watch.reading() as overview:
            return overview.status is not None and overview.status.state is ScopeState.SPEC

    def request(self, kind: int, subject: object = None) -> Response:
        """Send a request without a method in this class."""
        return self._ask(kind, subject)

    # --- within ---

    def _lend(self, settings: Sequence[Parameter]) -> Response | None:
        # None: they are in force. Once something was lent, also without settings: what was stated for a measurement
        # that did not begin must not hold for the next one.
        if not settings and not self._lends:
            return None
        self._lends = True  # also an unanswered request may be carried out
        self._link.pump(0.0)
        response = self._link.lend(settings, self._link.until(ANSWER_S))
        self._lends = response.code != ControlResponse.CMD_NOT_SUPPORTED  # by a scheduler of another make
        return None if response.ok else response

    def _ask(self, kind: int, subject: object = None, request_id: str = "") -> Response:
        self._link.pump(0.0)  # processes changes of the connection since the last request
        return self._link.request(kind, subject, request_id=request_id, until_s=self._link.until(ANSWER_S))

    def _wait_for(self, done: Callable[[Overview], bool], until_s: float) -> None:
        # a renewal of the lease must not wait for the microscope: the wait may outlast the lease
        while True:
            while self._meanwhile:
                self._meanwhile.popleft()()
            left_s = until_s - self._link.clock.monotonic_s()
            self._watch.wait_for(lambda o: done(o) or self._hurried() or bool(self._meanwhile), left_s)
            if not self._meanwhile:
                return

    def _settle(self, done: Callable[[Overview], bool]) -> None:
        # an unchanged value is not published, so the wait is bounded
        self._watch.wait_for(done, SETTLED_S)
