"""Actions of a person on a running experiment: requests to the scheduler, which may refuse them."""

from __future__ import annotations

import logging
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

from afspm import wire
from afspm.client.experiment_link import ExperimentLink
from afspm.client.parameter_values import from_parameter, to_parameter
from afspm.clock import Clock
from afspm.dashboard.access import Access, Visitor
from afspm.dashboard.watch import Watch
from afspm.errors import AfspmError, UnitError
from afspm.formatting import counted, quantity, typeset_position
from afspm.launch import Launch
from afspm.model import (
    RELAY_REQUEST,
    RESTART_REQUEST,
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
from afspm.model.events import PERSON
from afspm.model.geometry import XY
from afspm.process.context import new_session
from afspm.record.overview import Overview
from afspm.transport.network import Network
from afspm.transport.port import ParentGone
from afspm.transport.zmq_port import ZmqPort
from afspm.units import parse_quantity

ANSWER_S = 20.0  # real time that an answer may take
FREE_S = 60.0  # that the microscope may take to get to a place
SETTLED_S = 2.0  # what was set is published by then, if it changed anything
MOST_PERSONS = 32
_PAGE = ".page"  # no name of a person begins so


@dataclass(frozen=True)
class ActionResult:
    """The result of an action.

    Attributes:
        text: for the person, with the reason of a refusal.
        each: of an action on several parameters, the result for each by its name.
    """

    text: str
    ok: bool = True
    each: Mapping[str, ActionResult] = field(default_factory=dict)


_NOT_SIGNED_IN = ActionResult("Sign in first: what is done is in the record with a name.", ok=False)


def not_signed_in() -> Future[ActionResult]:
    """Return the answer to a person who has not signed in."""
    done: Future[ActionResult] = Future()
    done.set_result(_NOT_SIGNED_IN)
    return done


class Actions:
    """Actions in the name of one person, for one thread. None raises for a refusal; it is in the result."""

    def __init__(self, link: ExperimentLink, watch: Watch) -> None:
        self._link = link
        self._watch = watch

    # --- the experiment ---

    def set_mode(self, mode: ControlMode) -> ActionResult:
        """Set MANUAL or AUTOMATED."""
        return _result(self._ask(ControlRequest.SET_CONTROL_MODE, int(mode)), f"The mode is {mode.name}")

    def end(self) -> ActionResult:
        """End the experiment for everybody."""
        return _result(self._ask(ControlRequest.END_EXPERIMENT), "The experiment ends")

    def flag(self, problem: int) -> ActionResult:
        """Raise a problem."""
        response = self._ask(ControlRequest.ADD_EXP_PRBLM, problem)
        return _result(response, f"{self._watch.problems.name(problem)} is flagged")

    def clear(self, problem: int) -> ActionResult:
        """Remove the flag of a problem."""
        response = self._ask(ControlRequest.RMV_EXP_PRBLM, problem)
        return _result(response, f"{self._watch.problems.name(problem)} is cleared")

    def clear_all(self, problems: Sequence[int]) -> ActionResult:
        """Remove the flags of these problems; the first refusal ends it."""
        for problem in problems:
            if not (result := self.clear(problem)).ok:
                return result
        return ActionResult(f"Cleared {counted(len(problems), 'problem')}")

    def restart(self, process: str) -> ActionResult:
        """Have a process ended and started anew."""
        return _result(self._ask(RESTART_REQUEST, process), f"{process} will be started anew")

    def note(self, text: str, scan_ns: int | None = None, time_ns: int | None = None) -> ActionResult:
        """Write a note on a scan, on a moment, or on now."""
        now_ns = self._link.clock.now_ns()
        about_ns = next(one for one in (time_ns, scan_ns, now_ns) if one is not None)
        note = Note(about_ns, self._link.name, text, scan_ns, now_ns)
        return _result(self._ask(RELAY_REQUEST, RelayedMessage(*wire.encode(note))), "Noted")

    # --- the microscope, in MANUAL ---

    def stop_scan(self, *, by_manual: bool = False) -> ActionResult:
        """Stop the scan or spectrum that runs.

        Args:
            by_manual: switch to MANUAL before, which alone lets a person command the microscope.
        """
        if by_manual:
            result = self.set_mode(ControlMode.MANUAL)
            if not result.ok:
                return result
        with self._watch.reading() as overview:
            is_spectrum = overview.status is not None and overview.status.state is ScopeState.SPEC
        response = self._ask(ControlRequest.ACTION, names.STOP_SPEC if is_spectrum else names.STOP_SCAN)
        return _result(response, "The spectrum is stopped" if is_spectrum else "The scan is stopped")

    def read(self, parameters: Iterable[str]) -> ActionResult:
        """Return the values of parameters that are in force, with their units; one that is refused is not ok."""
        return ActionResult("", each={name: self._read(name) for name in parameters})

    def set(self, wanted: Mapping[str, str], shown: Mapping[str, str]) -> ActionResult:
        """Set parameters to quantities as a person writes them: "0.5 V", "2 um/s", "12". Each is asked for by itself.

        If one of them can't be what is meant, nothing is sent.

        Args:
            shown: the values that the person saw, with their units.
        """
        checked = {name: unclear(name, text, shown.get(name, "")) for name, text in wanted.items()}
        if wrong := {name: ActionResult(why, ok=False) for name, why in checked.items() if why}:
            text = " ".join(("Nothing was set.", *(one.text for one in wrong.values())))
            return ActionResult(text, ok=False, each=wrong)
        each = {name: self._set(name, text.strip()) for name, text in wanted.items()}
        refused = [one.text for one in each.values() if not one.ok]
        return ActionResult(" ".join(refused or [one.text for one in each.values()]), ok=not refused, each=each)

    def scan(self, region: Region | None = None, shape: tuple[int, int] | None = None) -> ActionResult:
        """Begin a scan; `region` and `shape` None: as they are set. It is done when the scan has begun."""
        if region is not None or shape is not None:
            wanted = ScanParameters(region, shape)
            response = self._ask(ControlRequest.SET_SCAN_PARAMS, wanted)
            if not response.ok:
                return _result(response, "")
            self._settle(lambda o: o.scan_parameters is not None and _fits(o.scan_parameters, wanted))
        where = "" if region is None else f" at {typeset_position(region.center_m)}"
        return _result(self._when_free(names.START_SCAN), f"The scan{where} begins")

    def spectrum(self, at_m: XY | None = None) -> ActionResult:
        """Begin a spectrum at (x, y); None: where the probe stands. It is done when it has begun."""
        if at_m is not None:
            response = self._ask(ControlRequest.SET_PROBE_POS, ProbePosition(at_m))
            if not response.ok:
                return _result(response, "")
            self._settle(lambda o: o.probe_position is not None and _near(o.probe_position.xy_m, at_m))
        where = "" if at_m is None else f" at {typeset_position(at_m)}"
        return _result(self._when_free(names.START_SPEC), f"The spectrum{where} begins")

    # --- within ---

    def _ask(self, kind: int, subject: object = None) -> Response:
        self._link.pump(0.0)  # what has come of the connection since we asked last
        return self._link.request(kind, subject, until_s=self._link.until(ANSWER_S))

    def _read(self, parameter: str) -> ActionResult:
        response = self._ask(ControlRequest.PARAM, Parameter(parameter))
        return ActionResult(_in_force(parameter, response)) if response.ok else _result(response, "")

    def _set(self, parameter: str, text: str) -> ActionResult:
        response = self._ask(ControlRequest.PARAM, to_parameter(parameter, _number_or(text), None))
        if not response.ok:
            which = "" if parameter in response.reason else f"{parameter}: "
            return ActionResult(f"{which}{refusal(response)}.", ok=False)
        now = _in_force(parameter, response) if response.payload else text
        return ActionResult(f"{parameter} is now {now}.")

    def _when_free(self, action: str) -> Response:
        """Ask for an action, again and again while the microscope is not free."""
        until_s = self._link.clock.monotonic_s() + FREE_S
        while True:
            self._watch.wait_free(until_s - self._link.clock.monotonic_s())
            with self._watch.reading():
                seen = self._watch.changes
            response = self._ask(ControlRequest.ACTION, action)
            if response.code != ControlResponse.NOT_FREE or self._link.clock.monotonic_s() >= until_s:
                return response
            self._watch.wait_for(lambda _, n=seen: self._watch.changes != n, 1.0)  # type: ignore[misc]

    def _settle(self, done: Callable[[Overview], bool]) -> None:
        """Wait until what was set is published; it is not where nothing changed."""
        self._watch.wait_for(done, SETTLED_S)


def _result(response: Response, done: str) -> ActionResult:
    return ActionResult(f"{done}.") if response.ok else ActionResult(refusal(response), ok=False)


def refusal(response: Response) -> str:
    """Return why something was not done, for a person."""
    code = ControlResponse(response.code).name if response.code in ControlResponse._value2member_map_ else response.code
    return f"Refused: {response.reason or 'no reason was given'} ({code})"


def _in_force(parameter: str, response: Response) -> str:
    """Return a value in SI where it has a unit, with the prefix that reads well."""
    if not response.payload:
        return "not told"
    said = wire.decode_parameter(response.payload)
    value = from_parameter(said, None)
    unit = names.BASE_PARAMETERS.get(parameter) or said.unit or ""
    if isinstance(value, bool) or not isinstance(value, float | int):
        return str(value)
    return f"{math.degrees(value):.6g} deg" if unit == "rad" else quantity(value, unit, 6)


def unclear(parameter: str, text: str, shown: str) -> str:
    """Return why a text can't be the value of a parameter; empty: it can. A number must have its unit, if there is one.

    >>> unclear("scan-speed", "8", "4 µm/s")
    'scan-speed: write the unit as well, for example "8 µm/s".'
    """
    unit = _unit_of(shown) or names.BASE_PARAMETERS.get(parameter)
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


def _fits(now: ScanParameters, wanted: ScanParameters) -> bool:
    if wanted.shape is not None and now.shape != wanted.shape:
        return False
    a, b = now.region, wanted.region
    return b is None or (isinstance(a, Region) and isinstance(b, Region) and _near(a.center_m, b.center_m))


def _near(a: XY, b: XY) -> bool:
    return math.dist(a, b) < 1e-3 * max(math.hypot(*b), 1e-9)


Action = Callable[[Actions], ActionResult]


@dataclass
class _Person:
    """A person's connection to the scheduler, used by one thread."""

    thread: ThreadPoolExecutor
    actions: Actions | None = None
    port: ZmqPort | None = None

    def close(self) -> None:
        if self.port is not None:
            self.port.wake_up(ParentGone())
            self.thread.submit(self.port.close)
        self.thread.shutdown(wait=False)


class Steering:
    """Carries out what persons ask for, each in the own name, one thing after the other for each.

    Args:
        launch: the line that the dashboard was started with; persons reach the scheduler as it does, with its keys.
        access: knows who has signed in.
    """

    def __init__(self, launch: Launch, clock: Clock, watch: Watch, access: Access) -> None:
        self._launch = launch
        self._access = access
        self._clock = clock
        self._watch = watch
        self._lock = threading.Lock()
        self._persons: OrderedDict[str, _Person] = OrderedDict()
        self._log = logging.getLogger("afspm.dashboard")

    def do(self, visitor: Visitor, action: Action) -> Future[ActionResult]:
        """Carry out an action in the name of a person, who must have one and not have signed out."""
        person = self._access.person_of(visitor)
        return self._submit(person, action) if person else not_signed_in()

    def read(self, action: Action) -> Future[ActionResult]:
        """Carry out an action that only reads, in the name of the page itself."""
        return self._submit(_PAGE, action)

    def _submit(self, person: str, action: Action) -> Future[ActionResult]:
        with self._lock:
            one = self._persons.get(person)
            if one is None:
                while len(self._persons) >= MOST_PERSONS:
                    self._persons.popitem(last=False)[1].close()
                one = self._persons[person] = _Person(ThreadPoolExecutor(1, thread_name_prefix="person"))
            self._persons.move_to_end(person)
            return one.thread.submit(self._carry_out, person, one, action)

    def close(self) -> None:
        """End all connections; what is under way ends without an answer."""
        with self._lock:
            persons, self._persons = list(self._persons.values()), OrderedDict()
        for one in persons:
            one.close()

    def _carry_out(self, person: str, one: _Person, action: Action) -> ActionResult:
        try:
            if one.actions is None:
                one.port, one.actions = self._connect(person)
            result = action(one.actions)
        except AfspmError as error:
            result = ActionResult(str(error), ok=False)
        except Exception as error:
            self._log.exception("an action of %s failed", person)
            result = ActionResult(f"that failed: {type(error).__name__}: {error}", ok=False)
        self._log.debug("%s: %s%s", person, result.text, "" if result.ok else " (not done)")
        return result

    def _connect(self, person: str) -> tuple[ZmqPort, Actions]:
        launch = self._launch
        name = f"{launch.name}{PERSON}{person}"
        network = Network.from_launch(launch.name, launch.keys)
        port = ZmqPort(network, name, self._clock, control=launch.sockets.control)
        link = ExperimentLink.of_launch(launch, port, new_session(launch.run), name=name, log=self._log)
        return port, Actions(link, self._watch)
