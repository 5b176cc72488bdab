"""Execution of requests: check everything first, then call the driver."""

from __future__ import annotations

import difflib
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

from afspm.basics import units
from afspm.basics.errors import AfspmError, ConfigError, InvalidValue, Refused
from afspm.basics.plain_data import PlainMapping
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    Request,
    Response,
    ResponseDetail,
    ScopeState,
    names,
    request_name,
)
from afspm.model.microscope_status import STARTS
from afspm.model.requests import COMPARE_REQUEST, Setting, Settings
from afspm.translator.claims import Claims
from afspm.translator.driver_base import LOST, Action, DriverBase
from afspm.translator.hurry import unhurried
from afspm.translator.panel_watch import PanelWatch
from afspm.translator.parameters import FEEDBACK_ON, Value
from afspm.translator.sequence import SequenceStep, StatusSequence
from afspm.translator.setters import PersonActs, apply, wanted_values
from afspm.translator.setting_groups import MOVES, of_message
from afspm.translator.temporary_settings import TemporarySettings, state_for
from afspm.wire import declared, encode

NEVER_SHOWN = "it needs a withdrawn tip, and this microscope never shows the tip: do it by hand, after `afspm pause`"
_ANNOUNCED = {one.set_by: one.name for one in declared() if one.set_by is not None}
_SETTERS = (*_ANNOUNCED, ControlRequest.PARAM)
ASIDE = "sent over the connection kept for it: its end is not seen while the other connections are lost"
"""The reason in the answer to a withdrawal that no further look can confirm."""
_MOST_CONTENDED = 2
"""Requests in a row that a client repeats because a person keeps changing the same values."""


@dataclass
class CommandOutcome:
    """The response to a request, with its consequences.

    Attributes:
        steps: steps to publish after the response.
        announce: messages to publish even if unchanged: the peer waits for them.
    """

    response: Response
    steps: list[SequenceStep] = field(default_factory=list)
    announce: tuple[str, ...] = ()


class StateAgain(Refused):
    """The refusal of a measurement whose settings are not in force any more; its client states them again."""


class Commands:
    """The executor of requests to one microscope.

    Args:
        panel: knows of a tip that a person has withdrawn.
        sequence: decides whether the microscope is free, and the order of published states.
        about_to_act: called after all checks, right before the first change.
        is_set: called with the values that a request has set, as read back.
        claims: knows what the next measurement states.
    """

    def __init__(
        self,
        driver: DriverBase,
        sequence: StatusSequence,
        temporary: TemporarySettings,
        panel: PanelWatch,
        about_to_act: Callable[[Request], None],
        is_set: Callable[[Mapping[str, Value]], None],
        claims: Claims,
        log: logging.Logger,
    ) -> None:
        self._driver = driver
        self._claims = claims
        self._sequence = sequence
        self._temporary = temporary
        self._panel = panel
        self._about_to_act = about_to_act
        self._is_set = is_set
        self._log = log
        self._contended = 0
        driver.for_a_while = temporary.begin
        self.actions = driver.own_actions() | self._added_actions(driver.common.actions)
        self.actions |= temporary.held.actions()
        if names.FEEDBACK_ON in driver.table and not driver.only_reads:
            self.actions[names.FEEDBACK_MAY_BE_OFF] = Action(names.FEEDBACK_MAY_BE_OFF, panel.may_be_off)

    def do(self, request: Request) -> CommandOutcome:
        """Execute a request; errors of the controller or its driver become the response.

        Raises:
            an error in `LOST`.
        """
        try:
            return self._dispatch(request)
        except StateAgain as refused:
            again = ResponseDetail.STATE_AGAIN
            return CommandOutcome(Response(refused.response, b"", refused.reason, request.id, again))
        except Refused as refused:
            return CommandOutcome(Response(refused.response, reason=refused.reason, id=request.id))
        except LOST:
            raise
        except AfspmError as error:
            # The controller's or the driver's own message says all that a person can use, and a traceback nothing more.
            self._log.error("%s failed: %s", request_name(request.kind), error)
            return self._failed(request, str(error))
        except Exception as error:
            # broad: a driver may raise anything, and must not end the process; its error is the reason of the refusal
            self._log.exception("%s failed", request_name(request.kind))
            return self._failed(request, f"{type(error).__name__}: {error}")

    def _failed(self, request: Request, reason: str) -> CommandOutcome:
        is_action = request.kind == ControlRequest.ACTION
        code = ControlResponse.ACTION_ERROR if is_action else ControlResponse.PARAM_ERROR
        return CommandOutcome(Response(code, reason=reason, id=request.id))

    def _dispatch(self, request: Request) -> CommandOutcome:
        if request.kind == ControlRequest.ACTION_SUPPORT:
            self._find_action(request.subject)
            return self._success(request)
        if request.kind == ControlRequest.ACTION:
            return self._act(request)
        if request.kind == COMPARE_REQUEST:
            return self._compare(request)
        if request.kind not in _SETTERS:
            reason = f"{request_name(request.kind)} is not for a translator"
            raise Refused(ControlResponse.CMD_NOT_SUPPORTED, reason)
        values = wanted_values(request, self._driver)
        return self._success(request) if values is None else self._set(request, values)

    def _success(self, request: Request, read_back: Mapping[str, Value] = MappingProxyType({})) -> CommandOutcome:
        # a parameter is returned in the unit that the peer used
        asked, payload = request.subject, b""
        if isinstance(asked, Parameter):
            spec = self._driver.table.find(asked.name)
            in_force = read_back or self._driver.in_force([spec.name])
            text, unit = spec.for_peer(in_force[spec.name], asked.unit)
            payload = encode(Parameter(spec.name, text, unit or None))[1]
        return CommandOutcome(Response(ControlResponse.SUCCESS, payload, id=request.id))

    def _compare(self, request: Request) -> CommandOutcome:
        # what the microscope does not show is left out of the answer
        table, asked = self._driver.table, {one.parameter.name: one for one in request.subject.settings}
        values = self._driver.reported([name for name in asked if name in table])
        claimed, found = dict[str, Value](), list[Setting]()
        for name, value in values.items():
            spec, one = table[name], asked[name]
            # a sweep may be finer than the resolution of a reading: a value that is new is set
            exact = one.known[:1] if one.is_claimed else ()
            known = tuple(
                there
                for there in (*one.known[len(exact) :], *exact)
                if self._is_there(there, value, None if there in exact else values)
            )
            if any(there in known for there in exact):
                claimed[name] = value
            text, unit = spec.for_peer(value, one.parameter.unit)
            found.append(Setting(Parameter(name, text, unit or None), known, is_lent=spec.may_be_lent))
        self._claims.compared(claimed, [name for name, one in asked.items() if not one.is_claimed])
        return CommandOutcome(Response(ControlResponse.SUCCESS, encode(Settings(tuple(found)))[1], id=request.id))

    def _is_there(self, there: Parameter, value: Value, among: Mapping[str, Value] | None) -> bool:
        # among: the values read together with it, for the precision of a reading; None: exactly
        spec = replace(self._driver.table[there.name], range=(-math.inf, math.inf), choices=())
        try:
            wanted = spec.parse(there.value or "", there.unit)
        except Refused:  # no value of this parameter: it can't be in force, and is refused when it is set
            return False
        if among is None:
            return replace(spec, resolution=0.0).same(value, wanted)
        return self._driver.same(there.name, value, wanted, among)

    def _set(self, request: Request, values: Mapping[str, Value]) -> CommandOutcome:
        driver = self._driver
        self._temporary.held.refuse_setting(values)
        self._refuse_if_busy(all(name in driver.adjustable or driver.table[name].while_busy for name in values))
        read_back = self._apply(values, lambda: self._about_to_act(request)) if values else {}
        self._is_set({name: read_back[name] for name in values})
        if MOVES & values.keys():
            self._temporary.held.moves_aside()
        moves = bool(MOVES & values.keys()) or (names.HELD_Z_OFFSET in values and self._temporary.held.is_held)
        steps = self._sequence.begin(ScopeState.MOVING) if moves else []
        done = self._success(request, read_back)
        done.steps = steps
        if request.kind == ControlRequest.PARAM:
            messages = (message for message in _ANNOUNCED.values() if set(of_message(message)) & values.keys())
            done.announce = tuple(messages)
        else:
            done.announce = (_ANNOUNCED[ControlRequest(request.kind)],)
        return done

    def _apply(self, values: Mapping[str, Value], about_to_act: Callable[[], None] = lambda: None) -> dict[str, Value]:
        if not self._passes_zero(values):
            return self._applied(values, about_to_act)
        about_to_act()
        return self._temporary.held.through_zero(partial(self._applied, values))

    def _passes_zero(self, values: Mapping[str, Value]) -> bool:
        # whether z is held for it
        driver, electrodes = self._driver, (names.TIP_BIAS_VOLTAGE, names.SAMPLE_BIAS)
        how, setpoint = driver.common.bias_through_zero, driver.table.get(names.ZCTRL_SETPOINT)
        if how == "jump" or values.keys().isdisjoint(electrodes) or setpoint is None or setpoint.si_unit != "A":
            return False
        shown = [one for one in (*electrodes, FEEDBACK_ON, names.ENGAGED) if one in driver.table]
        before = driver.in_force(shown)
        tip, second = ({**before, **values}.get(one, 0.0) for one in electrodes)
        gap_v = float(before[names.TIP_BIAS_VOLTAGE]) - float(before.get(names.SAMPLE_BIAS, 0.0))
        is_safe = before.get(FEEDBACK_ON) is False or before.get(names.ENGAGED) is False
        if is_safe or gap_v * (float(tip) - float(second)) >= 0.0:
            return False
        is_free = self._sequence.published.state is ScopeState.FREE
        if how == "hold" and is_free and driver.held_z is not None and FEEDBACK_ON in driver.table:
            return True
        why = "in a measurement" if not is_free else driver.cant_hold_z if how == "hold" else "as the file says"
        remedy = 'withdraw the tip first, or write bias_through_zero = "jump" into [microscope]'
        raise Refused(ControlResponse.PARAM_ERROR, f"the bias may not pass 0 V with the feedback on ({why}): {remedy}")

    def _applied(
        self, values: Mapping[str, Value], about_to_act: Callable[[], None] = lambda: None
    ) -> dict[str, Value]:
        try:
            read_back = apply(self._driver, values, about_to_act, self._panel.seen_in_request)
        except PersonActs as contended:
            self._contended += 1
            if self._contended <= _MOST_CONTENDED:
                raise
            self._contended = 0
            raise Refused(ControlResponse.PARAM_ERROR, contended.reason) from contended
        self._contended = 0
        return read_back

    def _act(self, request: Request) -> CommandOutcome:
        action = self._find_action(request.subject)
        state = self._sequence.published.state
        done = self._success(request)
        if action.only_stops and state not in action.interrupts:
            return done
        self._refuse_if_busy(action.while_busy)
        treatment, held = self._temporary.treatment, self._temporary.held
        held.refuse(action.name)
        if action.name in STARTS:
            self._refuse_without_tip()
            treatment.refuse_start()
            if why := self._claims.not_as_stated():
                raise StateAgain(ControlResponse.NOT_FREE, why)
            held.moves_aside()
        if action.needs_withdrawn:
            self._refuse_at_sample()
        treatment.forget()  # of a treatment that this action ends
        if action.name in names.TREATMENTS:
            treatment.expect(action.name, action.state)
        self._about_to_act(request)
        try:
            action.do()
        except LOST as error:
            if action.name != names.RETRACT or not self._withdrawn_elsewhere(error):
                raise  # it may have been carried out
            done.response = replace(done.response, reason=ASIDE)
        except Exception:  # a driver may raise anything; it is raised again
            treatment.forget()
            raise
        if state in action.interrupts:
            done.steps = self._sequence.interrupt()
        elif action.state is not None:
            done.steps = self._sequence.begin(action.state)
        return done

    def _withdrawn_elsewhere(self, why: Exception) -> bool:
        with unhurried():
            is_done = self._driver.withdraw_elsewhere()
        if is_done:
            self._log.warning("the tip was withdrawn over the connection kept for it, since %s", why)
        return is_done

    def _refuse_without_tip(self) -> None:
        # what the last look showed; a driver refuses by itself what else it knows, such as a safe tip
        tip = self._panel.tip
        if tip.remedy:
            raise Refused(ControlResponse.NOT_FREE, f"{tip.by_hand}; {tip.remedy}")
        if why_not := self._panel.feedback.why_not():
            raise Refused(ControlResponse.NOT_FREE, why_not)
        if tip.engaged is False and not self._driver.start_engages:
            if not self._panel.was_engaged and not self._driver.withdrew_tip():
                # a person has begun the run so, for example to commission the controller
                self._log.warning("the tip has been withdrawn since before this run: the measurement is in the air")
                return
            reason = self._driver.withdrew_tip()
            # unknown, as while the controller was lost: only a person can bring it back
            is_unknown = not reason and not self._panel.is_withdrawn_by_run
            code = ControlResponse.NOT_FREE if is_unknown else ControlResponse.ACTION_ERROR
            raise Refused(code, reason or "the tip is withdrawn: bring it to the sample first")

    def _refuse_at_sample(self) -> None:
        if names.ENGAGED not in self._driver.table:
            raise Refused(ControlResponse.ACTION_ERROR, NEVER_SHOWN)
        if self._driver.in_force([names.ENGAGED])[names.ENGAGED]:
            raise Refused(ControlResponse.ACTION_ERROR, "the tip is at the sample: withdraw it first (x-retract)")

    def _find_action(self, name: str) -> Action:
        if name in names.OF_HELD_Z_ACTIONS and name not in self.actions:
            raise Refused(ControlResponse.ACTION_NOT_SUPPORTED, f"z can't be held: {self._driver.cant_hold_z}")
        if name not in self.actions:
            # the name comes from a peer, and may be of any length
            near = difflib.get_close_matches(name[:100], self.actions, n=1)
            hint = f", perhaps {near[0]!r}" if near else ""
            raise Refused(ControlResponse.ACTION_NOT_SUPPORTED, f"this microscope has no action {name[:100]!r}{hint}")
        if name in self._driver.lacking:
            raise Refused(ControlResponse.ACTION_NOT_SUPPORTED, f"{name}: {self._driver.lacking[name]}")
        return self.actions[name]

    def _refuse_if_busy(self, allowed: bool) -> None:
        state = self._sequence.published.state
        if state is not ScopeState.FREE and not allowed:
            raise Refused(ControlResponse.NOT_FREE, f"the microscope is not free: SS_{state.name}")

    def _added_actions(self, given: PlainMapping) -> dict[str, Action]:
        added = {}
        for name, what in given.items():
            where = f"actions.{name}"
            does = isinstance(what, Mapping) and not {"set", "command"}.isdisjoint(what)
            known = {"set", "command", "for", "switches_feedback", "withdrawn"}
            if not does or not set(what) <= known or not isinstance(what.get("set", {}), Mapping):
                hint = (
                    '{ set = { "<parameter>" = <value> }, command = "<text>", for = "<time>",'
                    " switches_feedback = true, withdrawn = true }, or parts of it"
                )
                raise ConfigError(f"{what!r} is not an action", where=where, hint=hint)
            values = self._driver.table.written(what.get("set", {}), where=where)
            command = str(what["command"]) if "command" in what else None
            for_s = _duration_s(what["for"], f"{where}.for") if "for" in what else None
            moves = ScopeState.MOVING if MOVES & values.keys() else None
            state = moves if for_s is None else state_for(values)
            switches = bool(what.get("switches_feedback")) or (for_s is None and names.FEEDBACK_ON in values)
            try:
                commanded = dict(self._driver.values_commanded(what, self._driver.table))
                do = partial(self._run_added_action, values, command, for_s, commanded)
            except (InvalidValue, Refused) as error:
                do = partial(_refuse, str(error))
            needs_withdrawn = self._driver.needs_withdrawn(what)
            added[name] = Action(name, do, state, switches_feedback=switches, needs_withdrawn=needs_withdrawn)
        return added

    def _run_added_action(
        self, values: Mapping[str, Value], command: str | None, for_s: float | None, commanded: Mapping[str, Value]
    ) -> None:
        if commanded:
            self._driver.refuse_unreachable(commanded, self._driver.in_force(commanded))
        if for_s is not None:
            self._temporary.begin(values, for_s)
        elif values:
            self._apply(values)
        if command is not None:
            self._driver.command(command)


def _refuse(reason: str) -> None:
    raise Refused(ControlResponse.ACTION_ERROR, reason)


def _duration_s(given: Any, where: str) -> float:
    try:
        number, unit = units.parse_quantity(given) if isinstance(given, str) else (float(given), "")
        found = units.convert(number, unit or "s", "s")
    except (AfspmError, ValueError, TypeError) as error:
        raise ConfigError(f"{given!r} is not a duration: {error}", where=where) from error
    if not 0.0 < found < math.inf:
        raise ConfigError(f"{given!r} is not a duration", where=where, hint="more than 0 s")
    return found
