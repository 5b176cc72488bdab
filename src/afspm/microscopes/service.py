"""Answers requests: checks everything first, then has the microscope do it, then checks what came of it."""

from __future__ import annotations

import contextlib
import difflib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from afspm.errors import ConfigError, Refused
from afspm.microscopes.changes import asked_for, wanted_values
from afspm.microscopes.in_force import FRAME, MOVES, check_together, of_message
from afspm.microscopes.microscope import LOST, Action, Microscope
from afspm.microscopes.parameters import ParameterTable, Value, refuse_value
from afspm.microscopes.sequence import Sequence, Step
from afspm.model import ControlRequest, ControlResponse, Parameter, Request, Response, ScopeState, request_name
from afspm.wire import encode

_ANNOUNCED = {
    ControlRequest.SET_SCAN_PARAMS: "ScanParameters2d",
    ControlRequest.SET_ZCTRL_PARAMS: "ZCtrlParameters",
    ControlRequest.SET_PROBE_POS: "ProbePosition",
}
_SETTERS = (*_ANNOUNCED, ControlRequest.PARAM)


@dataclass
class Answer:
    """What a request comes to.

    Attributes:
        response: to send.
        steps: to publish after it.
        announce: messages to publish even if nothing in them changed: the peer waits for them.
    """

    response: Response
    steps: list[Step] = field(default_factory=list)
    announce: tuple[str, ...] = ()


class Service:
    """Answers requests to one microscope.

    Args:
        sequence: says whether the microscope is free, and in which order peers hear of it.
        about_to_act: called right before anything is done that can't be taken back.
    """

    def __init__(
        self,
        microscope: Microscope,
        sequence: Sequence,
        about_to_act: Callable[[Request], None],
        log: logging.Logger,
    ) -> None:
        self._microscope = microscope
        self._sequence = sequence
        self._about_to_act = about_to_act
        self._log = log
        self.actions = microscope.own_actions() | self._added_actions(microscope.added_actions)

    @property
    def _table(self) -> ParameterTable:
        """What the microscope has may only be known once it is connected."""
        return self._microscope.table

    def answer(self, request: Request) -> Answer:
        """The answer to a request, whatever is wrong with it or with the controller."""
        try:
            return self._dispatch(request)
        except Refused as refused:
            return Answer(Response(refused.response, reason=refused.reason, id=request.id))
        except LOST:
            raise
        except Exception as error:
            # an error of the controller, or of its own translator, must not end the process: it is the reason
            self._log.exception("%s failed", request_name(request.kind))
            code = _failure(request)
            return Answer(Response(code, reason=f"{type(error).__name__}: {error}", id=request.id))

    def _dispatch(self, request: Request) -> Answer:
        if request.kind == ControlRequest.ACTION_SUPPORT:
            self._find_action(request.subject)
            return Answer(Response(ControlResponse.SUCCESS, id=request.id))
        if request.kind == ControlRequest.ACTION:
            return self._act(request)
        if request.kind in _SETTERS:
            asked = asked_for(request.kind, request.payload)
            if asked:
                return self._set(request, wanted_values(asked, self._table))
            if request.kind == ControlRequest.PARAM:
                return Answer(self._told(request))
            return Answer(Response(ControlResponse.SUCCESS, id=request.id))
        reason = f"{request_name(request.kind)} is not for a translator"
        raise Refused(ControlResponse.CMD_NOT_SUPPORTED, reason)

    def _told(self, request: Request) -> Response:
        asked: Parameter = request.subject
        spec = self._table.find(asked.name)
        text, unit = spec.told(self._microscope.in_force([spec.name])[spec.name], asked.unit)
        payload = encode(Parameter(spec.name, text, unit or None))[1]
        return Response(ControlResponse.SUCCESS, payload, id=request.id)

    def _set(self, request: Request, asked: Mapping[str, Value]) -> Answer:
        values = self._settable(asked)
        self._refuse_if_busy(all(self._table[name].while_busy for name in values))
        if values:
            self._apply(values, lambda: self._about_to_act(request))
        steps = self._sequence.begin(ScopeState.MOVING) if MOVES & values.keys() else []
        if request.kind == ControlRequest.PARAM:
            announce = tuple(message for message in _ANNOUNCED.values() if set(of_message(message)) & values.keys())
            return Answer(self._told(request), steps, announce)
        announce = (_ANNOUNCED[ControlRequest(request.kind)],)
        return Answer(Response(ControlResponse.SUCCESS, id=request.id), steps, announce)

    def _settable(self, asked: Mapping[str, Value]) -> dict[str, Value]:
        """What is asked for without what can only be read: peers send back all of a message to change a part of it.

        Raises:
            Refused: PARAM_ERROR: what can only be read is to change.
        """
        fixed = [name for name in asked if self._table[name].read_only]
        now = self._microscope.in_force(fixed) if fixed else {}
        for name in fixed:
            if not self._table[name].same(now[name], asked[name]):
                reason = f"{name} can be asked for, not set: it is {self._table[name].quantity(now[name])}"
                raise Refused(ControlResponse.PARAM_ERROR, reason)
        return {name: value for name, value in asked.items() if name not in fixed}

    def _apply(self, values: Mapping[str, Value], about_to_act: Callable[[], None]) -> None:
        """Set the values, or change nothing.

        Raises:
            Refused: PARAM_ERROR: they do not fit together, or the controller made something else of them.
        """
        # all of a frame: setting a part of it, a controller may change the rest
        framed = FRAME if not values.keys().isdisjoint(FRAME) else ()
        whole = {*values, *(name for name in framed if name in self._table)}
        before = self._microscope.in_force(whole)
        wanted = {**before, **values}
        check_together(wanted, self._table, self._microscope.max_pixels)
        former = {name: value for name, value in before.items() if not self._table[name].read_only}
        about_to_act()
        try:
            self._microscope.put_in_force(values)
            after = self._microscope.in_force(whole)
        except LOST:
            raise
        except Exception:
            with contextlib.suppress(Exception):  # the first error is the one to tell
                self._microscope.put_in_force(former)
            raise
        for name, value in wanted.items():
            if not self._microscope.same(name, after[name], value, after):
                self._microscope.put_in_force(former)
                made, asked = (self._table[name].quantity(one) for one in (after[name], value))
                raise refuse_value(name, f"the controller made {made} of {asked}; nothing was changed")

    def _act(self, request: Request) -> Answer:
        action = self._find_action(request.subject)
        state = self._sequence.said.state
        done = Answer(Response(ControlResponse.SUCCESS, id=request.id))
        if action.only_stops and state not in action.interrupts:
            return done
        self._refuse_if_busy(action.while_busy)
        self._about_to_act(request)
        action.do()
        if state in action.interrupts:
            done.steps = self._sequence.interrupt()
        elif action.state is not None:
            done.steps = self._sequence.begin(action.state)
        return done

    def _find_action(self, name: str) -> Action:
        if name not in self.actions:
            near = difflib.get_close_matches(name[:100], self.actions, n=1)
            hint = f", perhaps {near[0]!r}" if near else ""
            raise Refused(ControlResponse.ACTION_NOT_SUPPORTED, f"this microscope has no action {name[:100]!r}{hint}")
        if name in self._microscope.lacking:
            raise Refused(ControlResponse.ACTION_NOT_SUPPORTED, f"{name}: {self._microscope.lacking[name]}")
        return self.actions[name]

    def _refuse_if_busy(self, allowed: bool) -> None:
        state = self._sequence.said.state
        if state is not ScopeState.FREE and not allowed:
            raise Refused(ControlResponse.NOT_FREE, f"the microscope is not free: SS_{state.name}")

    def _added_actions(self, given: Mapping[str, Any]) -> dict[str, Action]:
        added = {}
        for name, what in given.items():
            where = f"actions.{name}"
            if isinstance(what, Mapping) and set(what) == {"command"}:
                added[name] = Action(name, _bound(self._microscope.command, str(what["command"])))
            elif isinstance(what, Mapping) and set(what) == {"set"} and isinstance(what["set"], Mapping):
                values = self._table.written(what["set"], where=where)
                moves = ScopeState.MOVING if MOVES & values.keys() else None
                added[name] = Action(name, _bound(self._apply, values, _already_said), moves)
            else:
                hint = '{ set = { "<parameter>" = <value> } } or { command = "<text>" }'
                raise ConfigError(f"{what!r} is not an action", where=where, hint=hint)
        return added


def _bound(function: Callable[..., None], *arguments: Any) -> Callable[[], None]:
    return lambda: function(*arguments)


def _already_said() -> None:
    """The request behind an action was written down before the action began."""


def _failure(request: Request) -> ControlResponse:
    if request.kind == ControlRequest.ACTION:
        return ControlResponse.ACTION_ERROR
    return ControlResponse.PARAM_ERROR
