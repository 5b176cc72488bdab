"""Commands to the microscope, repeated with the same id until they are answered, and refused loudly."""

from __future__ import annotations

from collections.abc import Callable

from afspm import wire
from afspm.basics.errors import NoResponse, Refused
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    MeasurementSettings,
    Parameter,
    RelayedMessage,
    Response,
    ResponseDetail,
    ScopeState,
    request_name,
)

PATIENCE_S = 60.0  # real time that a translator may take to be there again
RETRY_S = 1.0  # before an unreachable one is asked again, when nothing is published in between
STATE_WITHIN_S = 5.0  # before a warning that the microscope has published no state
CONNECTED_WITHIN_S = 5.0  # before a warning that the scheduler has no connection to the translator (yet)
SETTLED_WITHIN_S = 2.0  # what was set is published, if it changed anything
ASK_FREE_AGAIN_S = 5.0  # should the state FREE never reach us
ASK_BUSY_AGAIN_S = 25.0  # the same where another state than FREE was published

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
}
_NO_STATE = (
    "waiting for the microscope, which has published no state yet: is its translator running? If it never publishes "
    "what is in force when a scheduler connects: restart it, or scan once by hand"
)
NOT_IN_CONTROL = {ControlResponse.NOT_IN_CONTROL, ControlResponse.WRONG_CONTROL_MODE}


class CommandRetry:
    """Asks the microscope for something, through the scheduler, in control."""

    def __init__(self, link: ExperimentLink, control: ControlHold) -> None:
        self._link = link
        self._control = control

    def ask(self, kind: ControlRequest, subject: object = None, *, until_s: float | None = None) -> Response:
        """Ask for a command until it succeeds. Control must be held around it; where it is lost it is waited for.

        Not so in an unbroken block: what comes in the tenure after may find the microscope otherwise.

        Raises:
            Refused: the microscope, or a limit, says no.
            NoResponse: the microscope stays silent, or is not free until `until_s`; or, in an unbroken block, control
                was lost before an action was answered.
            ControlLost: control was not back until `until_s`; or, in an unbroken block, was lost, and no action done.
        """
        request_id = self._link.next_id()
        while True:
            self._control.regain(until_s)
            states = self._link.view.count("ScopeStateMsg")
            try:
                response = self.send(kind, subject, request_id=request_id, until_s=until_s)
            except KeyboardInterrupt:
                if kind == ControlRequest.ACTION:
                    told = "interrupted before the answer: the microscope may have carried out %s"
                    self._link.log.warning(told, subject)
                raise
            if response.ok:
                return response
            if response.code != ControlResponse.NO_RESPONSE:  # else it may have been carried out: the same id again
                self.get_over(kind, response, states, until_s)
                request_id = self._link.next_id()
            elif kind == ControlRequest.ACTION and self._control.is_unbroken:  # what is set is set anew
                raise NoResponse(
                    f"control was lost before the action was answered: {self._control.why_lost}",
                    where=self._link.name,
                    hint="it may or may not have been carried out",
                )

    def in_control(self, kind: ControlRequest, subject: object, until_s: float | None) -> Response:
        """`ask`, with control held around it."""
        with self._control.hold(until_s=until_s):
            return self.ask(kind, subject, until_s=until_s)

    def read(self, kind: ControlRequest, subject: object, until_s: float | None) -> Response:
        """Ask for a reading; where the scheduler gives it to the holder of control alone, take control around it."""
        response = self.send(kind, subject, until_s=until_s)
        if response.code != ControlResponse.NOT_IN_CONTROL:
            return response
        with self._control.hold(until_s=until_s):
            return self.send(kind, subject, until_s=until_s)

    def set(self, kind: ControlRequest, wanted: object, message: str, until_s: float | None) -> None:
        """Ask for a setting, and wait until its `message` is published and the tip has stopped moving.

        A microscope that publishes nothing, since nothing changed, is not waited for long.
        """
        link, view = self._link, self._link.view
        count = view.count(message)
        self.ask(kind, wanted, until_s=until_s)
        if link.wait(lambda: view.count(message) != count, link.earlier(SETTLED_WITHIN_S, until_s)):
            link.wait(lambda: view.state is not ScopeState.MOVING, until_s)

    def set_parameter(self, wanted: Parameter, until_s: float | None) -> Parameter:
        """Set a parameter and return it as it is then in force. Control must be held around it. Raises as `ask`."""
        response = self.ask(ControlRequest.PARAM, wanted, until_s=until_s)
        return wire.decode_parameter(response.payload) if response.payload else wanted

    def publish_settings(self, settings: tuple[Parameter, ...], key: str) -> None:
        """Have the scheduler publish the parameters that a sweep has set for the measurement of a key."""
        link = self._link
        message = MeasurementSettings(link.clock.now_ns(), link.name, settings, key)
        response = link.request(RELAY_REQUEST, RelayedMessage(*wire.encode(message)))
        if not response.ok:  # a scheduler of another make may not know the message
            link.log.warning("the record lacks the swept parameters of this measurement: %s", response.reason)

    def send(
        self,
        kind: ControlRequest,
        subject: object = None,
        *,
        request_id: str = "",
        until_s: float | None = None,
        is_seen: Callable[[], bool] = lambda: False,
    ) -> Response:
        """Ask once, with patience for a microscope that is silent: the same id has it executed once.

        Args:
            is_seen: returns whether what was asked for is seen to happen, which is as good as an answer.

        Returns:
            The answer; NO_RESPONSE only if control was lost before there was any.

        Raises:
            NoResponse: it stays silent.
        """
        link = self._link
        request_id = request_id or link.next_id()
        give_up_s = link.earlier(PATIENCE_S, until_s)
        is_repeated = is_told = False
        self._wait_for_state(give_up_s)
        late_s = link.earlier(CONNECTED_WITHIN_S, give_up_s)
        while True:
            response = link.request(kind, subject, request_id=request_id, until_s=until_s)
            if is_repeated and response.code in NOT_IN_CONTROL:  # now; whether it was done before is still unknown
                self._control.lost(response.reason)
                return Response(ControlResponse.NO_RESPONSE, reason=response.reason, id=request_id)
            if response.code != ControlResponse.NO_RESPONSE or self._control.was_lost:
                return response
            if is_seen():
                return Response(ControlResponse.SUCCESS, id=request_id)
            if link.clock.monotonic_s() >= give_up_s:
                raise NoResponse(
                    f"the microscope does not answer {kind.name}: {response.reason or 'no reason given'}",
                    where=link.name,
                    hint="is its translator running? it may or may not have been carried out",
                )
            if not is_told and (response.detail is not ResponseDetail.NOT_SENT or link.clock.monotonic_s() >= late_s):
                why = response.reason or "no reason given"
                link.log.warning("the microscope does not answer %s (%s); asking again", kind.name, why)
                is_told = True
            is_repeated = True
            self._wait_for_news(link.earlier(RETRY_S, give_up_s))

    def get_over(self, kind: ControlRequest, response: Response, states: int, until_s: float | None) -> None:
        """After a response that is no success: wait for what stands in the way, or raise Refused.

        Args:
            states: how many states had been published before it was asked.
        """
        if response.code == ControlResponse.NO_RESPONSE:
            return  # control is lost, and waited for when it is asked again
        if response.code in NOT_IN_CONTROL:
            self._control.lost(response.reason)
        elif response.code == ControlResponse.NOT_FREE:
            self._wait_free(states, until_s)
        else:
            raise refused(kind, response, self._link.name)

    def _wait_for_state(self, give_up_s: float) -> None:
        """Wait for the first state: a microscope that has not said a word yet is still starting, and would refuse."""
        link = self._link
        link.wait(lambda: link.view.status is not None, link.earlier(STATE_WITHIN_S, give_up_s))
        if link.view.status is None:
            link.log.warning("%s", _NO_STATE)
            link.wait(lambda: link.view.status is not None, give_up_s)

    def _wait_free(self, states: int, until_s: float | None) -> None:
        """Wait until the microscope says that it is free, later than `states`; not for ever, should that get lost."""
        link, view = self._link, self._link.view

        def is_free() -> bool:
            return view.state is ScopeState.FREE and view.count("ScopeStateMsg") != states

        if not link.wait(is_free, link.earlier(ASK_FREE_AGAIN_S, until_s)) and view.state is not ScopeState.FREE:
            link.log.info("waiting until the microscope is free; it is %s", view.state.name)
            link.wait(is_free, link.earlier(ASK_BUSY_AGAIN_S, until_s))
        if until_s is not None and link.clock.monotonic_s() >= until_s:
            raise NoResponse(f"the microscope was not free in time: it is {view.state.name}", where=link.name)

    def _wait_for_news(self, until_s: float) -> None:
        """Wait until the microscope says anything or control changes."""
        view = self._link.view

        def counts() -> tuple[int, int]:
            return view.count("ScopeStateMsg"), view.count("ControlState")

        before = counts()
        self._link.wait(lambda: counts() != before, until_s)


def refused(kind: int, response: Response, where: str) -> Refused:
    """Return a response as the error that it is."""
    known = response.code in ControlResponse._value2member_map_
    code = ControlResponse(response.code).name if known else str(response.code)
    what = _ASKED_FOR.get(kind, request_name(kind))
    return Refused(response.code, f"{what} was refused: {response.reason or code}", where=where, hint=code)
