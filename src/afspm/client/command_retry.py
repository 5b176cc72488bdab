"""Commands to the microscope, repeated with the same id until they are answered; refusals become errors."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Collection, Sequence
from datetime import UTC

from afspm import wire
from afspm.basics.errors import NoResponse, NotClear, Refused
from afspm.basics.formatting import day_and_time
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.parameter_text import Value, value_in
from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    Parameter,
    RelayedMessage,
    Request,
    Response,
    ResponseDetail,
    ScopeState,
    request_name,
)
from afspm.model.events import MeasurementSettings
from afspm.model.microscope_status import feedback_of
from afspm.model.requests import LEND_REQUEST, RETURN_REQUEST, Setting, Settings
from afspm.transport.port import CUT_OFF_SHOWS_WITHIN_S
from afspm.wire.messages import FEEDBACK, LENT_SETTINGS

PATIENCE_S = 60.0  # real time for the restart of a translator
RETRY_S = 1.0  # before a repetition, unless a state is published earlier
STATE_WITHIN_S = 5.0  # before the warning that the microscope has published no state
CONNECTED_WITHIN_S = 5.0  # before the warning that the scheduler has no connection to the translator (yet)
SETTLED_WITHIN_S = 2.0  # for the publication of a setting; without a change there is none
# real time that a free microscope must stay free until an action counts as not begun, once the translator has answered
# that it never learns the outcome. A controller that is back may begin late: Nanonis moves the tip first, up to 10 s.
LOST_AFTER_S = 2 * CUT_OFF_SHOWS_WITHIN_S
ASK_FREE_AGAIN_S = 5.0  # in case the state FREE was lost
ASK_BUSY_AGAIN_S = 25.0  # the same after another state than FREE

_ASKED_FOR: dict[int, str] = {
    ControlRequest.ACTION: "the action",
    ControlRequest.ACTION_SUPPORT: "asking for an action",
    ControlRequest.PARAM: "the parameter",
    ControlRequest.SET_SCAN_PARAMS: "the region or shape of the scan",
    ControlRequest.SET_ZCTRL_PARAMS: "the setting of the feedback",
    ControlRequest.SET_PROBE_POS: "the position of the probe",
    ControlRequest.REQUEST_CTRL: "control",
    ControlRequest.ADD_EXP_PRBLM: "flagging a problem",
    ControlRequest.RMV_EXP_PRBLM: "clearing a problem",
    ControlRequest.SET_CONTROL_MODE: "the mode",
    ControlRequest.END_EXPERIMENT: "ending the experiment",
    RELAY_REQUEST: "the note",
    LEND_REQUEST: "a setting of the measurement",
}
_NO_STATE = (
    "waiting for the microscope, which has published no state yet: is its translator running? If it does not "
    "publish its state when a scheduler connects: restart it, or scan once by hand"
)
_NUMBERS = re.compile(r"[-+]?\d[\d.e+-]*")
NOT_IN_CONTROL = {ControlResponse.NOT_IN_CONTROL, ControlResponse.WRONG_CONTROL_MODE}


class CommandRetry:
    """A sender of commands to the microscope, through the scheduler, for a component in control.

    Attributes:
        may_have_lent: whether the scheduler may have something to set back.
        states: whether something was stated since the last measurement began.
        decided: parameters that can't be lent, and stay as they were set, with the values before; None: unknown.
    """

    def __init__(self, link: ExperimentLink, control: ControlHold) -> None:
        self._link = link
        self._control = control
        self._logged_reason = ""
        self._logged_limits: set[str] = set()
        self._lends = True
        self.may_have_lent = True
        self.states = False
        self.decided: dict[str, Parameter | None] = {}

    def ask(self, kind: int, subject: object = None, *, until_s: float | None = None) -> Response:
        """Send a command until it succeeds, inside a block with control; after a loss of control, wait to regain it.

        In an unbroken block a loss of control is an error: other components may have changed the microscope meanwhile.

        Raises:
            Refused: the microscope or a limit refuses.
            NoResponse: the microscope stays silent, or is not free by `until_s`; or, in an unbroken block, control was
                lost before an action was answered.
            ControlLost: control was not regained by `until_s`, or was lost in an unbroken block.
        """
        request_id = self._link.next_id()
        while True:
            self._control.regain(until_s)
            states = self._link.view.count("ScopeStateMsg")
            try:
                response = self.send(kind, subject, request_id=request_id, until_s=until_s)
            except KeyboardInterrupt:
                if kind == ControlRequest.ACTION:
                    text = "interrupted before the answer: the microscope may have carried out %s"
                    self._link.log.warning(text, subject)
                raise
            if response.ok:
                return response
            # after NO_RESPONSE it may have been carried out: keep the id
            if response.code != ControlResponse.NO_RESPONSE:
                self.get_over(kind, response, states, until_s)
                request_id = self._link.next_id()
            # settings may be repeated, actions may not
            elif kind == ControlRequest.ACTION and self._control.is_unbroken:
                raise NoResponse(
                    f"control was lost before the action was answered: {self._control.why_lost}",
                    where=self._link.name,
                    hint="it may or may not have been carried out",
                )

    def in_control(self, kind: ControlRequest, subject: object, until_s: float | None) -> Response:
        """Take control for one command, and send the command until it succeeds. Raises as `ask`."""
        with self._control.hold(until_s=until_s):
            return self.ask(kind, subject, until_s=until_s)

    def read(self, kind: ControlRequest, subject: object, until_s: float | None) -> Response:
        """Send a read-only request, and return the answer; take control first if the scheduler demands control."""
        # without a response control was lost meanwhile, as by a controller that comes up late
        while (response := self.send(kind, subject, until_s=until_s)).code == ControlResponse.NO_RESPONSE:
            self._control.regain(until_s)
        if response.code != ControlResponse.NOT_IN_CONTROL:
            return response
        with self._control.hold(until_s=until_s):
            return self.send(kind, subject, until_s=until_s)

    def value(self, parameter: str, unit: str | None, until_s: float | None) -> Value:
        """Return a parameter's value, in the unit as for `value_in`. Raises Refused if it can't be read."""
        asked = Parameter(parameter)
        response = self.read(ControlRequest.PARAM, asked, until_s)
        if not response.ok:
            raise refused(ControlRequest.PARAM, response, parameter)
        return value_in(response, asked, unit)

    def set(self, kind: ControlRequest, wanted: object, message: str, until_s: float | None) -> None:
        """Send a setting; wait until its `message` is published and the tip has stopped moving. Raises as `ask`.

        If nothing is published, since nothing changed, the wait ends after `SETTLED_WITHIN_S`.
        """
        link, view = self._link, self._link.view
        count = view.count(message)
        self.ask(kind, wanted, until_s=until_s)
        if link.wait(lambda: view.count(message) != count, link.earlier(SETTLED_WITHIN_S, until_s)):
            with link.clock.passing():
                link.wait(lambda: view.state is not ScopeState.MOVING, until_s)

    def set_parameter(self, wanted: Parameter, until_s: float | None) -> Parameter:
        """Set a parameter, and return the value in force. Control must be held. Raises as `ask`."""
        response = self.ask(ControlRequest.PARAM, wanted, until_s=until_s)
        return wire.decode_parameter(response.payload) if response.payload else wanted

    def lend(
        self,
        wanted: Sequence[Parameter],
        until_s: float | None,
        settle_s: float | None = None,
        swept: Collection[str] = (),
    ) -> dict[str, Parameter]:
        """Set what the next measurement states, and return the values in force by name. Control must be held.

        The scheduler sets the former values back for measurements that do not state them. Raises as `ask`.

        Args:
            swept: the parameters that are points of a sweep: no person's value takes the place of theirs.
        """
        settings = tuple(Setting(one, is_swept=one.name in swept) for one in wanted)
        if self._lends:
            try:
                response = self.ask(LEND_REQUEST, Settings(settings, settle_s), until_s=until_s)
            except Refused as refusal:
                if refusal.response != ControlResponse.CMD_NOT_SUPPORTED:
                    raise
                self._lends = False
                self._link.log.warning("this scheduler lends no settings: they are set, and stay in force")
            else:
                found: Settings = wire.decode(LENT_SETTINGS.name, response.payload)
                self.may_have_lent, self.states = True, bool(wanted)
                for one in found.settings:
                    if one.is_lent is False:
                        self.decided.setdefault(one.parameter.name, one.known[0] if one.known else None)
                return {one.name: one for one in found.parameters}
        return {one.name: self.set_parameter(one, until_s) for one in wanted}

    def give_back(self, names: Sequence[str], until_s: float | None) -> None:
        """Let the scheduler set back what was lent, now or as soon as it can; without names, all of it.

        Also what an earlier life of this component has lent.

        Raises:
            NoResponse: the scheduler does not answer by `until_s`.
        """
        if not (names or self.may_have_lent):
            return
        link = self._link
        while True:
            response = link.request(RETURN_REQUEST, Settings.of(*map(Parameter, names)), until_s=until_s)
            if response.again_ns is None or not self._control.wait_for_limit(response.again_ns, until_s):
                break
            self._log_limit(response.again_ns, response.reason)
        if not response.ok:
            link.log.warning("settings of measurements are not set back: %s", response.reason)
        self.may_have_lent = bool(names)

    def publish_settings(self, settings: tuple[Parameter, ...], key: str, point: int | None = None) -> None:
        """Ask the scheduler to publish the parameters that a sweep has set for the measurement `key`."""
        link = self._link
        message = MeasurementSettings(link.clock.now_ns(), link.name, settings, key, point)
        response = link.request(RELAY_REQUEST, RelayedMessage(*wire.encode(message)))
        if not response.ok:  # a scheduler of another make may not know the message
            link.log.warning("the record lacks the swept parameters of this measurement: %s", response.reason)

    def send(
        self,
        kind: int,
        subject: object = None,
        *,
        request_id: str = "",
        until_s: float | None = None,
        is_seen: Callable[[], bool] = lambda: False,
        is_lost: Callable[[], bool] = lambda: False,
    ) -> Response:
        """Send a request, and repeat it while the microscope is silent: with the same id, so that it is executed once.

        Args:
            is_seen: returns whether the effect of the request has been observed, which counts as an answer.
            is_lost: returns whether the request has had no effect so far. It counts as lost if that holds for
                `LOST_AFTER_S` after the translator has answered that it does not know the outcome.

        Returns:
            The answer; NO_RESPONSE only if control was lost before any answer, or if the request `is_lost`.

        Raises:
            NoResponse: the microscope stays silent.
        """
        link = self._link
        request_id = request_id or link.next_id()
        before = self._control.switched
        if (feedback := feedback_of(Request(kind, subject))) is not None and feedback.on is not None:
            self._control.switched = link.view.count(FEEDBACK.name), feedback.on
        give_up_s = link.earlier(PATIENCE_S, until_s)
        is_repeated = has_warned = False
        self._wait_for_state(give_up_s)
        late_s = link.earlier(CONNECTED_WITHIN_S, give_up_s)
        idle_until_s: float | None = None
        while True:
            response = link.request(kind, subject, request_id=request_id, until_s=until_s)
            # refused now; an earlier repetition may have been executed
            if is_repeated and response.code in NOT_IN_CONTROL:
                self._control.lost(response.reason)
                return Response(ControlResponse.NO_RESPONSE, reason=response.reason, id=request_id)
            if response.ok:
                self._logged_reason = ""
            if response.code != ControlResponse.NO_RESPONSE or self._control.was_lost:
                if not response.ok and response.code != ControlResponse.NO_RESPONSE:
                    self._control.switched = before  # it was refused
                return response
            if is_seen():
                return Response(ControlResponse.SUCCESS, id=request_id)
            # a repeated id gets its recorded answer, without a detail: the translator never learns the outcome
            is_final = response.detail is ResponseDetail.NONE and bool(response.reason)
            now_s = link.clock.monotonic_s()
            if not (is_final and is_lost()):
                idle_until_s = None
            elif idle_until_s is None:
                idle_until_s = now_s + LOST_AFTER_S
            elif now_s >= idle_until_s and (until_s is None or now_s < until_s):
                return response
            # a controller that came back late gets the full time, too
            end_s = give_up_s if idle_until_s is None else max(give_up_s, idle_until_s)
            end_s = end_s if until_s is None else min(end_s, until_s)
            if now_s >= end_s:
                raise NoResponse(
                    f"the microscope does not answer {request_name(kind)}: {response.reason or 'no reason given'}",
                    where=link.name,
                    hint="is its translator running? the request may or may not have been carried out",
                )
            if not has_warned and (response.detail is not ResponseDetail.NOT_SENT or now_s >= late_s):
                why = response.reason or "no reason given"
                link.log.warning("the microscope does not answer %s (%s); asking again", request_name(kind), why)
                has_warned = True
            is_repeated = True
            self._wait_for_news(link.earlier(RETRY_S, end_s))

    def get_over(self, kind: int, response: Response, states: int, until_s: float | None) -> None:
        """Handle a failed response: record a loss of control, or wait for a free microscope or a limit on time.

        Args:
            states: number of states published before the request.

        Raises:
            Refused: the response has another cause, which no wait can remove; or a limit demands a longer wait.
            NoResponse: the microscope was not free by `until_s`.
        """
        if response.code == ControlResponse.NO_RESPONSE:
            return  # control was lost: the caller regains it before the next attempt
        if response.detail is ResponseDetail.STATE_AGAIN:
            self._link.log.info("the settings are stated again: %s", response.reason)
        elif response.code in NOT_IN_CONTROL:
            self._control.lost(response.reason)
        elif response.code == ControlResponse.NOT_FREE:
            self._log_reason(response.reason)
            with self._link.clock.passing():
                self._wait_free(states, until_s)
        elif response.again_ns is not None:
            self._log_limit(response.again_ns, response.reason)
            if not self._control.wait_for_limit(response.again_ns, until_s):
                raise refused(kind, response, self._link.name)
        else:
            raise refused(kind, response, self._link.name)

    def _wait_for_state(self, give_up_s: float) -> None:
        # a microscope without a published state is still starting, and would refuse
        link = self._link
        link.wait(lambda: link.view.status is not None, link.earlier(STATE_WITHIN_S, give_up_s))
        if link.view.status is None:
            link.log.warning("%s", _NO_STATE)
            link.wait(lambda: link.view.status is not None, give_up_s)

    def _log_reason(self, reason: str) -> None:
        # a busy microscope is seen in its state; a condition that does not hold is seen nowhere else
        kind = _NUMBERS.sub("", reason)
        if self._link.view.state is ScopeState.FREE and kind != self._logged_reason:
            self._link.log.info("waiting: %s", reason)
            self._logged_reason = kind

    def _log_limit(self, again_ns: int, reason: str) -> None:
        # once for each limit: a plan of a night may wait before each of its scans
        kind = _NUMBERS.sub("", reason)
        level = logging.DEBUG if kind in self._logged_limits else logging.INFO
        self._link.log.log(level, "waiting until %s: %s", day_and_time(again_ns, UTC), reason)
        self._logged_limits.add(kind)

    def _wait_free(self, states: int, until_s: float | None) -> None:
        # a state later than `states`; with a time limit, in case the state FREE is lost
        link, view = self._link, self._link.view

        def is_free() -> bool:
            return view.state is ScopeState.FREE and view.count("ScopeStateMsg") != states

        if not link.wait(is_free, link.earlier(ASK_FREE_AGAIN_S, until_s)) and view.state is not ScopeState.FREE:
            link.log.info("waiting until the microscope is free; it is %s", view.state.name)
            link.wait(is_free, link.earlier(ASK_BUSY_AGAIN_S, until_s))
        if until_s is not None and link.clock.monotonic_s() >= until_s:
            raise NoResponse(f"the microscope was not free in time: it is {view.state.name}", where=link.name)

    def _wait_for_news(self, until_s: float) -> None:
        view = self._link.view

        def counts() -> tuple[int, int]:
            return view.count("ScopeStateMsg"), view.count("ControlState")

        before = counts()
        self._link.wait(lambda: counts() != before, until_s)


def refused(kind: int, response: Response, where: str) -> Refused:
    """Return the error for a refused request."""
    known = response.code in ControlResponse._value2member_map_
    code = ControlResponse(response.code).name if known else str(response.code)
    what = _ASKED_FOR.get(kind, request_name(kind))
    why = f"{what} was refused: {response.reason or code}"
    error = NotClear if response.detail is ResponseDetail.STEP_AWAY_AGAIN else Refused
    return error(response.code, why, where=where, hint=code, again_ns=response.again_ns)
