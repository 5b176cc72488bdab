"""Actions of a person on a running experiment: requests to the scheduler, which may refuse them."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field

from afspm import wire
from afspm.basics import AfspmError, Plain, UnitError, counted, parse_quantity, quantity, typeset_position
from afspm.client import from_parameter, value_in
from afspm.model import (
    CLOCK_REQUEST,
    GRANT_REQUEST,
    XY,
    ControlMode,
    ControlResponse,
    Grant,
    Parameter,
    Region,
    Response,
    names,
)
from afspm.plugins.web.dashboard.access import Access, Visitor
from afspm.plugins.web.person_commands import PersonCommands
from afspm.plugins.web.persons import Persons
from afspm.plugins.web.watch import Watch

_PAGE = ".page"  # no person's name begins with a dot


@dataclass(frozen=True)
class ActionResult:
    """The result of an action.

    Attributes:
        text: message for the person, with the reason of a refusal.
        each: result by parameter name, if the action set or read several parameters.
    """

    text: str
    ok: bool = True
    each: Mapping[str, ActionResult] = field(default_factory=dict)


_NOT_SIGNED_IN = ActionResult("Sign in first: the record keeps the name with each action.", ok=False)


def not_signed_in() -> Future[ActionResult]:
    """Return the result for a viewer who is not signed in."""
    done: Future[ActionResult] = Future()
    done.set_result(_NOT_SIGNED_IN)
    return done


class Actions:
    """The actions of one person, for use in one thread. Refusals are returned in the result, not raised."""

    def __init__(self, commands: PersonCommands, watch: Watch) -> None:
        self._commands = commands
        self._watch = watch

    # --- the experiment ---

    def set_mode(self, mode: ControlMode) -> ActionResult:
        return _result(self._commands.set_mode(mode), f"The mode is {mode.name}")

    def end(self) -> ActionResult:
        """End the experiment for everyone."""
        return _result(self._commands.end(), "The experiment is ending")

    def flag(self, problem: int) -> ActionResult:
        return _result(self._commands.flag(problem), f"{self._watch.problems.name(problem)} is flagged")

    def clear(self, problem: int) -> ActionResult:
        return _result(self._commands.clear(problem), f"{self._watch.problems.name(problem)} is cleared")

    def clear_all(self, problems: Sequence[int]) -> ActionResult:
        """Clear these problems; stop at the first refusal."""
        for problem in problems:
            if not (result := self.clear(problem)).ok:
                return result
        return ActionResult(f"Cleared {counted(len(problems), 'problem')}")

    def approve(self, grant: Grant) -> ActionResult:
        """Approve a plan of an agent, give the agent a grant, or revoke its approvals."""
        done = "are revoked" if grant.revokes else f"include {grant.plan or 'the grant'}"
        return _result(self._commands.request(GRANT_REQUEST, grant), f"The approvals of {grant.agent} {done}")

    def approval_facts(self) -> Plain:
        """Return the present facts for an approval: run, limits, coordinates and time.

        Raises:
            AfspmError: the scheduler does not provide them.
        """
        response = self._commands.request(CLOCK_REQUEST)
        if not response.ok:
            raise AfspmError(refusal(response))
        facts: Plain = json.loads(response.payload)
        return facts

    def settle_plan(self, parameter: str, *, keeps: bool) -> ActionResult:
        """Let plans measure with the value that a person has set in MANUAL, or with the one that they state."""
        value = "the value that was set" if keeps else "their own value"
        return _result(self._commands.settle_plan(parameter, keeps=keeps), f"Plans measure with {value} of {parameter}")

    def scan_speed_m_s(self) -> float | None:
        """Return the scan speed in force; None if the microscope does not have it."""
        response = self._commands.get(names.SCAN_SPEED)
        value = value_in(response, Parameter(names.SCAN_SPEED), None) if response.ok else None
        return value if isinstance(value, float) else None

    def restart(self, process: str) -> ActionResult:
        return _result(self._commands.restart(process), f"{process} is being restarted")

    def note(self, text: str, scan_ns: int | None = None, time_ns: int | None = None) -> ActionResult:
        """Write a note about a scan or a time, by default the present."""
        return _result(self._commands.note(text, scan_ns, time_ns), "Noted")

    # --- the microscope, in MANUAL ---

    def stop_scan(self, *, by_manual: bool = False) -> ActionResult:
        """Stop the running scan or spectrum.

        Args:
            by_manual: first switch to MANUAL: in AUTOMATED, scans belong to the component in control.
        """
        if by_manual:
            result = self.set_mode(ControlMode.MANUAL)
            if not result.ok:
                return result
        what = "spectrum" if self._commands.measures_spectrum else "scan"
        return _result(self._commands.stop(), f"The {what} is stopped")

    def read(self, parameters: Iterable[str]) -> ActionResult:
        """Return the present values of parameters with their units; the result of a refused parameter is not `ok`."""
        return ActionResult("", each={name: self._read(name) for name in parameters})

    def set(self, wanted: Mapping[str, str], shown: Mapping[str, str]) -> ActionResult:
        """Set parameters, one request each, to quantities written by a person: "0.5 V", "2 um/s", "12".

        Nothing is sent if a quantity is ambiguous. Reasons of refusals are in `each` alone: the form shows each of them
        below its field.

        Args:
            shown: the values that the person saw, with their units.
        """
        checked = {name: unclear(name, text, shown.get(name, "")) for name, text in wanted.items()}
        if wrong := {name: ActionResult(why, ok=False) for name, why in checked.items() if why}:
            return ActionResult(f"Nothing was set. Refused: {', '.join(wrong)}.", ok=False, each=wrong)
        each = {name: self._set(name, text.strip()) for name, text in wanted.items()}
        if refused := [name for name, one in each.items() if not one.ok]:
            return ActionResult(f"Refused: {', '.join(refused)}.", ok=False, each=each)
        return ActionResult(" ".join(one.text for one in each.values()), each=each)

    def scan(self, region: Region | None = None, shape: tuple[int, int] | None = None) -> ActionResult:
        """Begin a scan, and return once the microscope has accepted it; None keeps the present `region` or `shape`."""
        if (refused := self._commands.prepare_scan(region, shape)) is not None:
            return _result(refused, "")
        where = "" if region is None else f" at {typeset_position(region.center_m)}"
        return _result(self._commands.act_when_free(names.START_SCAN), f"The scan{where} begins")

    def spectrum(self, at_m: XY | None = None) -> ActionResult:
        """Begin a spectrum at (x, y), or at the probe's position for None; return once the microscope accepts it."""
        if (refused := self._commands.prepare_spectrum(at_m)) is not None:
            return _result(refused, "")
        where = "" if at_m is None else f" at {typeset_position(at_m)}"
        return _result(self._commands.act_when_free(names.START_SPEC), f"The spectrum{where} begins")

    # --- within ---

    def _read(self, parameter: str) -> ActionResult:
        response = self._commands.get(parameter)
        return ActionResult(_in_force(parameter, response)) if response.ok else _result(response, "")

    def _set(self, parameter: str, text: str) -> ActionResult:
        response = self._commands.set(parameter, _number_or(text))
        if not response.ok:
            which = "" if parameter in response.reason else f"{parameter}: "
            return ActionResult(f"{which}{refusal(response)}.", ok=False)
        now = _in_force(parameter, response) if response.payload else text
        return ActionResult(f"{parameter} is now {now}.")


def _result(response: Response, done: str) -> ActionResult:
    return ActionResult(f"{done}.") if response.ok else ActionResult(refusal(response), ok=False)


def refusal(response: Response) -> str:
    """Return the reason of a refusal as text for a person."""
    if response.reason:
        return f"Refused: {response.reason}"
    code = ControlResponse(response.code).name if response.code in ControlResponse._value2member_map_ else response.code
    return f"Refused: no reason given ({code})"


def _in_force(parameter: str, response: Response) -> str:
    # in SI units if the parameter has a unit, with a readable prefix
    if not response.payload:
        return "unknown"
    parameter_now = wire.decode_parameter(response.payload)
    value = from_parameter(parameter_now, None)
    unit = names.UNITS_OF_REQUESTS.get(parameter) or parameter_now.unit or ""
    if isinstance(value, bool) or not isinstance(value, float | int):
        return str(value)
    return f"{math.degrees(value):.6g} deg" if unit == "rad" else quantity(value, unit, 6)


def unclear(parameter: str, text: str, shown: str) -> str:
    """Return the reason why a text is ambiguous as a parameter's value; empty if it is clear.

    A number without a unit is ambiguous if the parameter has a unit other than px.

    >>> unclear("scan-speed", "8", "4 µm/s")
    'scan-speed: write the unit as well, for example "8 µm/s".'
    """
    unit = _unit_of(shown) or names.UNITS_OF_REQUESTS.get(parameter)
    if not text.strip():
        return f"{parameter}: write a value."
    try:
        _, given = parse_quantity(text)
    except UnitError as error:
        return f"{parameter}: {error}." if unit is not None else ""
    if given or not unit or unit == "px":
        return ""
    return f'{parameter}: write the unit as well, for example "{text.strip()} {unit}".'


def _unit_of(shown: str) -> str:
    try:
        return parse_quantity(shown)[1]
    except UnitError:
        return ""


def _number_or(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


Action = Callable[[Actions], ActionResult]


class Steering:
    """An executor of persons' actions: each under the person's name, and one person's actions in order.

    Args:
        access: decides which viewers are signed in.
    """

    def __init__(self, persons: Persons, watch: Watch, access: Access) -> None:
        self._persons = persons
        self._access = access
        self._watch = watch
        self._log = logging.getLogger("afspm.plugins.web.dashboard")

    def do(self, visitor: Visitor, action: Action, *, urgent: bool = False) -> Future[ActionResult]:
        """Start an action in the name of a signed-in visitor; a visitor without a session gets a refusal.

        Args:
            urgent: earlier actions of this person stop waiting for a free microscope.
        """
        person = self._access.person_of(visitor)
        return self._submit(person, action, urgent=urgent) if person else not_signed_in()

    def read(self, action: Action) -> Future[ActionResult]:
        """Start an action that only reads, under the page's own name."""
        return self._submit(_PAGE, action)

    def close(self) -> None:
        """End all connections; pending actions end without an answer."""
        self._persons.close()

    def _submit(self, person: str, action: Action, *, urgent: bool = False) -> Future[ActionResult]:
        return self._persons.submit(person, lambda commands: self._carry_out(person, commands, action), urgent=urgent)

    def _carry_out(self, person: str, commands: PersonCommands, action: Action) -> ActionResult:
        try:
            result = action(Actions(commands, self._watch))
        except AfspmError as error:
            result = ActionResult(str(error), ok=False)
        except Exception as error:  # a defect in an action is shown to its person, and must not end the page
            self._log.exception("an action of %s failed", person)
            result = ActionResult(f"The action failed: {type(error).__name__}: {error}", ok=False)
        self._log.debug("%s: %s%s", person, result.text, "" if result.ok else " (not done)")
        return result
