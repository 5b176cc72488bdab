"""Answers requests: checks everything first, then has the microscope do it, then checks what came of it."""

from __future__ import annotations

import contextlib
import difflib
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from afspm import units
from afspm.errors import AfspmError, ConfigError, Refused
from afspm.model import ControlRequest, ControlResponse, Parameter, Request, Response, ScopeState, request_name
from afspm.translator.driver import LOST, Action, Driver
from afspm.translator.parameters import ParameterTable, Value, refuse_value
from afspm.translator.sequence import SequenceStep, StatusSequence
from afspm.translator.setters import asked_for, wanted_values
from afspm.translator.settings import FRAME, MOVES, check_together, of_message
from afspm.translator.temporary_settings import TemporarySettings, state_for
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
    steps: list[SequenceStep] = field(default_factory=list)
    announce: tuple[str, ...] = ()


class RequestHandler:
    """Answers requests to one microscope.

    Args:
        sequence: says whether the microscope is free, and in which order peers hear of it.
        about_to_act: called right before anything is done that can't be taken back.
        save: writes `kept`, which is JSON-able, down.

    Attributes:
        temporary: what an action has put in force for a while.
    """

    def __init__(
        self,
        microscope: Driver,
        sequence: StatusSequence,
        about_to_act: Callable[[Request], None],
        kept: dict[str, Any],
        save: Callable[[], None],
        log: logging.Logger,
    ) -> None:
        self._microscope = microscope
        self._sequence = sequence
        self._about_to_act = about_to_act
        self._log = log
        self.temporary = TemporarySettings(microscope, kept, self._apply_unasked, save, log)
        microscope.for_a_while = self.temporary.begin
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
                return self._set(request, wanted_values(asked, self._table, self._is_in_force))
            if request.kind == ControlRequest.PARAM:
                return Answer(self._told(request))
            return Answer(Response(ControlResponse.SUCCESS, id=request.id))
        reason = f"{request_name(request.kind)} is not for a translator"
        raise Refused(ControlResponse.CMD_NOT_SUPPORTED, reason)

    def _is_in_force(self, name: str, value: Value) -> bool:
        now = self._microscope.in_force([name])
        return self._microscope.same(name, now[name], value, now)

    def _told(self, request: Request) -> Response:
        asked: Parameter = request.subject
        spec = self._table.find(asked.name)
        text, unit = spec.told(self._microscope.in_force([spec.name])[spec.name], asked.unit)
        payload = encode(Parameter(spec.name, text, unit or None))[1]
        return Response(ControlResponse.SUCCESS, payload, id=request.id)

    def _set(self, request: Request, values: Mapping[str, Value]) -> Answer:
        self._refuse_if_busy(all(self._table[name].while_busy for name in values))
        if values:
            self._apply(values, lambda: self._about_to_act(request))
        steps = self._sequence.begin(ScopeState.MOVING) if MOVES & values.keys() else []
        if request.kind == ControlRequest.PARAM:
            announce = tuple(message for message in _ANNOUNCED.values() if set(of_message(message)) & values.keys())
            return Answer(self._told(request), steps, announce)
        announce = (_ANNOUNCED[ControlRequest(request.kind)],)
        return Answer(Response(ControlResponse.SUCCESS, id=request.id), steps, announce)

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

    def _apply_unasked(self, values: Mapping[str, Value]) -> None:
        """Apply values within an action, or at its end: the request behind it was written down before it began."""
        self._apply(values, lambda: None)

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
            is_table = isinstance(what, Mapping) and set(what) <= {"set", "command", "for"} and len(what) > 0
            if not is_table or set(what) == {"for"} or not isinstance(what.get("set", {}), Mapping):
                hint = (
                    '{ set = { "<parameter>" = <value> }, command = "<text>", for = "<time>" }, of these what is needed'
                )
                raise ConfigError(f"{what!r} is not an action", where=where, hint=hint)
            values = self._table.written(what.get("set", {}), where=where)
            command = str(what["command"]) if "command" in what else None
            for_s = _duration_s(what["for"], f"{where}.for") if "for" in what else None
            moves = ScopeState.MOVING if MOVES & values.keys() else None
            added[name] = Action(
                name, partial(self._do, values, command, for_s), moves if for_s is None else state_for(values)
            )
        return added

    def _do(self, values: Mapping[str, Value], command: str | None, for_s: float | None) -> None:
        """Do what an action of the experiment file says."""
        if for_s is not None:
            self.temporary.begin(values, for_s)
        elif values:
            self._apply_unasked(values)
        if command is not None:
            self._microscope.command(command)


def _duration_s(given: Any, where: str) -> float:
    try:
        number, unit = units.parse_quantity(given) if isinstance(given, str) else (float(given), "")
        found = units.convert(number, unit or "s", "s")
    except (AfspmError, ValueError, TypeError) as error:
        raise ConfigError(f"{given!r} is no duration: {error}", where=where) from error
    if not 0.0 < found < math.inf:
        raise ConfigError(f"{given!r} is no duration", where=where, hint="more than 0 s")
    return found


def _failure(request: Request) -> ControlResponse:
    if request.kind == ControlRequest.ACTION:
        return ControlResponse.ACTION_ERROR
    return ControlResponse.PARAM_ERROR
