"""`CheckClient`: sends requests like a component, through the scheduler, and records publications."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from typing import Any, TypeVar

from afspm import wire
from afspm.basics.clock import Clock
from afspm.basics.errors import ExperimentEnded, NoResponse, WireError
from afspm.client.experiment_link import ExperimentLink
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Packet,
    Parameter,
    Response,
    Role,
    Scan,
    ScanLines,
    ScopeState,
    ScopeStatus,
    Spectrum,
    names,
)
from afspm.testing.conformance import Failed, Lost, expect
from afspm.transport.process.parent import StopRequested

T = TypeVar("T")


@dataclass(frozen=True)
class Observation:
    """A received packet.

    Attributes:
        message: the name of the message.
        thing: the content of the packet, or the error that prevents decoding.
        time_ns: the time of publication; None without one.
    """

    message: str
    thing: Any
    time_ns: int | None

    @property
    def state(self) -> ScopeState | None:
        """The state in a status message; None in other messages."""
        return self.thing.state if isinstance(self.thing, ScopeStatus) else None

    def __str__(self) -> str:
        if self.state is not None:
            return f"SS_{self.state.name}"
        if isinstance(self.thing, Scan):
            return f"Scan2d {self.thing.channel!r}"
        if isinstance(self.thing, WireError):
            return f"{self.message} that can't be read: {self.thing}"
        return self.message


class Observations:
    """All packets about the microscope, oldest first.

    Attributes:
        lines: the lines of running scans, which are not in `all`.
    """

    def __init__(self) -> None:
        self.all: list[Observation] = []
        self.lines: list[ScanLines] = []

    def take(self, packet: Packet, ours: bool) -> None:
        """Record a packet of the translator, or an unreadable packet; a listener of an `ExperimentLink`."""
        message = packet.envelope
        try:
            message = wire.message_of(packet.envelope)
            thing = wire.decode(message, bytes(packet.payload))
        except WireError as error:
            thing = error
        # other packets come from the scheduler, or only on request of a client
        if isinstance(thing, ScanLines):
            self.lines.append(thing)
        elif isinstance(thing, WireError) or _is_always_published(wire.declaration(message)):
            self.all.append(Observation(message, thing, packet.time_ns))

    def mark(self) -> int:
        """Return the present position, for `since`."""
        return len(self.all)

    def since(self, mark: int) -> list[Observation]:
        """Return the observations after `mark`."""
        return self.all[mark:]

    def newest(self, kind: type[T]) -> T | None:
        """Return the newest content of a type; None without one."""
        return next((one.thing for one in reversed(self.all) if isinstance(one.thing, kind)), None)

    def has(self, wanted: ScopeState | type, mark: int) -> bool:
        """Return whether a state, or a content of a type, was published after `mark`."""
        if isinstance(wanted, ScopeState):
            return any(one.state is wanted for one in self.all[mark:])
        return any(isinstance(one.thing, wanted) for one in self.all[mark:])

    def at_s(self, state: ScopeState, mark: int) -> float | None:
        """Return the first experiment time of a state after `mark`; None if it was not published."""
        times = (one.time_ns for one in self.all[mark:] if one.state is state and one.time_ns is not None)
        return next((time_ns / 1e9 for time_ns in times), None)


def _is_always_published(message: wire.MessageDeclaration) -> bool:
    return message.source is Role.TRANSLATOR and message.always


def describe_all(observed: Iterable[Observation]) -> str:
    """Return the observations in words; more than two equal ones in a row as their number."""
    groups = [(text, len(list(same))) for text, same in groupby(map(str, observed))]
    return (
        ", ".join(f"{text} ({count} times)" if count > 2 else ", ".join([text] * count) for text, count in groups)
        or "nothing"
    )


def scans(observed: Iterable[Observation]) -> list[Scan]:
    return [one.thing for one in observed if isinstance(one.thing, Scan)]


def spectra(observed: Iterable[Observation]) -> list[Spectrum]:
    return [one.thing for one in observed if isinstance(one.thing, Spectrum)]


def states(observed: list[Observation]) -> list[str]:
    """Return the names of the states, without consecutive repetitions."""
    found: list[str] = []
    for one in observed:
        if one.state is not None and str(one) not in found[-1:]:
            found.append(str(one))
    return found


STARTED_S = 30.0
"""Longest real seconds until translator and scheduler run and the microscope is free."""
ANSWERED_S = 15.0
"""Longest real seconds until an answer: more than the scheduler's wait for the translator."""
NOTICED_S = 10.0
"""Longest real seconds until the effect of a request is published."""
QUIET_S = 0.2
"""Real seconds without a packet that count as a pause."""
MOVED_S = 60.0
"""Longest experiment seconds of a move."""

_STOPS = {ScopeState.SCANNING: names.STOP_SCAN, ScopeState.SPEC: names.STOP_SPEC}


_ANSWERS = "a scheduler that answers (of a running experiment: one with `[security] insecure = true`)"


class CheckClient:
    """A component that records every publication.

    Args:
        link: connection to the scheduler; may still be connecting.
        direct: connection to the translator, bypassing the scheduler's own refusals; None: use `link` instead.
        lost: returns a description of the ended processes, after a link reports the end of the parent.
        patience: a factor of all limits in real time: above 1 where the microscope is simulated on a busy computer.

    Attributes:
        observations: all publications.
        at_start: the publications until control was granted, before the first request to the microscope.
    """

    def __init__(
        self, link: ExperimentLink, direct: ExperimentLink | None, lost: Callable[[], str], patience: float = 1.0
    ) -> None:
        self._link = link
        self.patience = patience
        self._direct = direct or link
        self._lost = lost
        self.clock: Clock = link.clock
        self.observations = Observations()
        self.at_start: tuple[Observation, ...] = ()
        self._stirred = True
        self._interrupted = False
        link.listen(self.observations.take)

    # --- beginning and ending ---

    def begin(self) -> None:
        """Wait for the microscope, and take control.

        Raises:
            Lost: the microscope is missing, or control was not granted.
        """
        try:
            started_s = STARTED_S * self.patience
            self.wait(lambda: self._link.connected and self._link.is_caught_up(), started_s, _ANSWERS)
            self.wait(
                lambda: self.observations.newest(ScopeStatus) is not None,
                started_s,
                "a ScopeStateMsg of the translator",
            )
            self.wait(lambda: self.state is not ScopeState.UNDEFINED, started_s, "a connection to the controller")
        except Failed as failure:
            raise Lost(str(failure)) from failure
        response = self._request_over(self._link, ControlRequest.REQUEST_CTRL, 0)
        if not response.ok:
            raise Lost(f"control was refused: {answer_in_words(response)}")
        self.quiet()
        self.at_start = tuple(self.observations.all)

    def regain_control(self, within_s: float) -> None:
        """Request control again, after a loss of the controller and of control.

        Raises:
            Lost: control is not granted within `within_s` real seconds.
        """
        until_s = self.clock.monotonic_s() + within_s
        while not (response := self._request_over(self._link, ControlRequest.REQUEST_CTRL, 0)).ok:
            if self.clock.monotonic_s() >= until_s:
                raise Lost(f"control was refused: {answer_in_words(response)}")
            self.quiet()

    def continue_run(self, within_s: float) -> str:
        """Let the run continue after an act at the panel, which has taken control away, and request control again.

        Returns:
            what a person has to do at the panel first; empty: the run continues.

        Raises:
            Lost: control is not granted within `within_s` real seconds.
        """
        response = self._request_over(self._link, ControlRequest.SET_CONTROL_MODE, int(ControlMode.AUTOMATED))
        if not response.ok:
            return answer_in_words(response)
        self.regain_control(within_s)
        return ""

    def end(self) -> None:
        """Release control."""
        self._link.send_only(ControlRequest.RELEASE_CTRL)

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt (after Ctrl-C) at the next wait or request of the checks.

        An interrupt elsewhere could cut a request in two; later requests, which restore settings, would be misread.
        """
        self._interrupted = True
        self._link.port.wake_up()

    def _heed(self) -> None:
        if self._interrupted:
            self._interrupted = False
            raise KeyboardInterrupt

    # --- asking ---

    def ask(self, kind: ControlRequest, subject: object = None) -> Response:
        """Send a request; return the answer, even a refusal.

        Raises:
            Failed: there is no answer.
            Lost: a process has ended, or control was taken away.
        """
        response = self._request_over(self._link, kind, subject)
        if response.code == ControlResponse.NOT_IN_CONTROL:
            raise Lost(f"control was lost: {response.reason}")
        return response

    def ask_directly(self, kind: ControlRequest, subject: object) -> Response:
        """Send a request over `direct`, to test the translator's own refusals."""
        return self._request_over(self._direct, kind, subject)

    def _request_over(self, link: ExperimentLink, kind: ControlRequest, subject: object) -> Response:
        self._heed()
        within_s = ANSWERED_S * self.patience
        try:
            with self._alive():
                response = link.request(kind, subject, until_s=link.until(within_s))
        except NoResponse:
            raise Failed(f"an answer to REQ_{kind.name}", f"none within {within_s:g} s") from None
        self._stirred |= response.ok and not _only_asks(kind, subject)
        return response

    def asked(self, kind: ControlRequest, subject: object, what: str) -> Response:
        """Send a request that must succeed. Raises as `ask`."""
        response = self.ask(kind, subject)
        expect(response.ok, f"REP_SUCCESS to {what}", answer_in_words(response))
        return response

    def get(self, name: str, unit: str | None = None) -> Parameter:
        """Return a parameter's value as reported."""
        return value_in(self.asked(ControlRequest.PARAM, Parameter(name, None, unit), f"getting {name}"), name)

    def set(self, name: str, value: str, unit: str | None = None) -> Response:
        """Request a change of a parameter; return the answer, even a refusal."""
        return self.ask(ControlRequest.PARAM, Parameter(name, value, unit))

    # --- hearing ---

    @property
    def state(self) -> ScopeState:
        newest = self.observations.newest(ScopeStatus)
        return ScopeState.UNDEFINED if newest is None else newest.state

    def wait(self, done: Callable[[], bool], within_s: float, expected: str) -> None:
        """Wait until a condition on the observations holds, up to `within_s` real seconds.

        Raises:
            Failed: a timeout.
        """
        mark = self.observations.mark()
        self._wait(done, within_s, expected, mark)

    def awaited_newest(self, kind: type[T], expected: Callable[[T], bool]) -> T | None:
        """Return the newest publication of a kind: the expected one, unless it has not come within `NOTICED_S`.

        A pause in the publications is no sign that none follows: on a busy computer any process may pause.
        """

        def has_come() -> bool:
            newest = self.observations.newest(kind)
            return newest is not None and expected(newest)

        self._awaited(has_come, NOTICED_S * self.patience)
        return self.observations.newest(kind)

    def wait_state(self, state: ScopeState, mark: int, within_s: float | None = None) -> None:
        """Wait until a state is published after `mark`; None: as long as the effect of a request may take."""
        within_s = NOTICED_S * self.patience if within_s is None else within_s
        self._wait(lambda: self.observations.has(state, mark), within_s, f"SS_{state.name}", mark)

    def _wait(self, done: Callable[[], bool], within_s: float, expected: str, mark: int) -> None:
        came = self._awaited(done, within_s)
        expect(came, f"{expected} within {within_s:.3g} s", describe_all(self.observations.since(mark)))

    def _awaited(self, done: Callable[[], bool], within_s: float) -> bool:
        def done_or_interrupted() -> bool:
            self._heed()
            return done()

        with self._alive():
            return self._link.wait(done_or_interrupted, self._link.until(within_s))

    def settled(
        self, mark: int, experiment_s: float = MOVED_S, *, awaiting: ScopeState | type | None = None
    ) -> list[Observation]:
        """Wait until the microscope is free and quiet; return all publications after `mark`.

        Args:
            awaiting: a publication that certainly follows `mark`, and is waited for first.
        """
        if awaiting is not None:
            self._awaited(lambda: self.observations.has(awaiting, mark), self.real_s(experiment_s))
        self.quiet()
        if self.state is not ScopeState.FREE:
            self.wait(lambda: self.state is ScopeState.FREE, self.real_s(experiment_s), "SS_FREE")
            self.quiet()
        return self.observations.since(mark)

    def quiet(self) -> None:
        """Wait for a pause in the publications, at most `NOTICED_S`."""
        self._stirred = False
        until_s = self.clock.monotonic_s() + NOTICED_S
        while self.clock.monotonic_s() < until_s:
            count = len(self.observations.all)
            if not self._awaited(lambda n=count: len(self.observations.all) != n, QUIET_S):  # type: ignore[misc]
                return

    def real_s(self, experiment_s: float) -> float:
        """Return the longest real time for an experiment time, plus a delay for the publication."""
        return self.clock.real_s(experiment_s) + NOTICED_S * self.patience

    def come_to_rest(self) -> None:
        """Stop a running scan or spectrum, and wait until the microscope is free.

        Raises:
            Lost: the activity does not stop.
        """
        if self.state is not ScopeState.FREE:
            mark = self.observations.mark()
            if self.state in _STOPS:
                self.ask(ControlRequest.ACTION, _STOPS[self.state])
            try:
                self.wait(lambda: self.state is ScopeState.FREE, self.real_s(MOVED_S), "SS_FREE")
            except Failed as failure:
                raise Lost(
                    f"the microscope does not become free: {failure} ({describe_all(self.observations.since(mark))})"
                ) from failure
        if self._stirred:
            self.quiet()

    @contextmanager
    def _alive(self) -> Iterator[None]:
        try:
            yield
        except StopRequested:
            raise Lost(self._lost()) from None
        except ExperimentEnded as ended:
            raise Lost(str(ended)) from ended


def _only_asks(kind: ControlRequest, subject: object) -> bool:
    return kind is ControlRequest.ACTION_SUPPORT or (isinstance(subject, Parameter) and subject.value is None)


def answer_in_words(response: Response) -> str:
    """Return a response's code and reason as text."""
    known = response.code in ControlResponse._value2member_map_
    code = f"REP_{ControlResponse(response.code).name}" if known else f"response {response.code}"
    return f"{code} ({response.reason})" if response.reason else code


def value_in(response: Response, name: str) -> Parameter:
    """Return the parameter in a successful answer.

    Raises:
        Failed: no readable parameter, another parameter, or no value.
    """
    try:
        found = wire.decode_parameter(response.payload)
    except WireError as error:
        raise Failed(f"REP_SUCCESS with a ParameterMsg of {name}", f"one that can't be read: {error}") from error
    expect(found.name == name, f"the value of {name}", f"the value of {found.name!r}")
    expect(found.value is not None, f"REP_SUCCESS with the value of {name} in force", "no value")
    return found
