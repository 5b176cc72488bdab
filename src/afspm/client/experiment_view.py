"""Views of an experiment: state, settings in force, published messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from numbers import Integral

from afspm import wire
from afspm.basics.argument_checks import FINITE, NAME, NUMBER, SECONDS, TEXT, WHOLE, Argument, checked, is_number, plain
from afspm.basics.errors import AfspmError, ExperimentEnded, InvalidValue
from afspm.client.events import Events
from afspm.client.experiment_link import ExperimentLink
from afspm.model import (
    ChannelRoles,
    ControlMode,
    ControlState,
    Feedback,
    ProbePosition,
    ProblemNames,
    Scan,
    ScanParameters,
    ScopeState,
    TipStatus,
)
from afspm.model.caption import in_force, settings_to_lend
from afspm.model.state import FeedbackUnits
from afspm.transport.process.parent import StopRequested

_PROBLEM = Argument(
    "a problem's name or number", lambda value: isinstance(value, str | Integral), '"tip-shape-changed"'
)
_MODE = Argument(
    "a mode", lambda value: isinstance(value, int) and value in {*ControlMode}, "ControlMode.MANUAL or .AUTOMATED"
)
checked_call = checked({
    **dict.fromkeys(("parameter", "name", "action", "process"), NAME),
    **dict.fromkeys(("text", "unit", "kind", "key"), TEXT),
    **dict.fromkeys(("problem", "solving"), _PROBLEM),
    **dict.fromkeys(("done", "of", "time_ns", "seed"), WHOLE),
    **dict.fromkeys(("proportional_gain", "integral_gain"), FINITE),
    "setpoint": Argument(FINITE.what, FINITE.fits, 'scope.set("zctrl-setpoint", "50 pA") takes a text with a unit'),
    "timeout_s": SECONDS,
    "left_s": NUMBER,
    "on": Argument("True or False", lambda value: isinstance(plain(value), int) and plain(value) in (0, 1)),
    "mode": _MODE,
    "grant": Argument("a grant", lambda value: hasattr(value, "agent")),
    "scan": Argument("a scan", lambda value: hasattr(value, "time_ns"), "a ScanSet, a Scan, or a row of run.scans"),
    "condition": Argument("a function", callable, "e.g. lambda: scope.in_control"),
    "parameters": Argument(
        "a dict of values by parameter",
        lambda value: isinstance(value, Mapping) and all(map(NAME.fits, value)),
        'e.g. {"scan-speed": ["1 um/s", "2 um/s"]}',
    ),
})  # fmt: skip
"""A decorator that checks the arguments of a scope's calls by their names, before anything is sent."""


class ExperimentView:
    """The part of `Scope` that sends no requests.

    Args:
        between: called after each successful measurement, request (except for control), `wait_until` or `sleep`;
            never within one of them.
    """

    def __init__(self, link: ExperimentLink, problems: ProblemNames, between: Callable[[], None]) -> None:
        self._link = link
        self._between = between
        self._depth = 0
        self.problems = problems

    def __repr__(self) -> str:
        with suppress(AfspmError):  # e.g. after the end: show the last known state
            self._catch_up()
        view = self._link.view
        control = view.control or ControlState(ControlMode.UNDEFINED)
        flagged = "".join(f", {self.problems.name(number)} is flagged" for number in control.problems)
        holder = control.holder or "no component"
        return f"<Scope {self._link.name!r}: {view.state.name}, {control.mode.name}, {holder} is in control{flagged}>"

    @property
    def state(self) -> ScopeState:
        """Return the state of the microscope; UNDEFINED if the microscope has published none."""
        self._catch_up()
        return self._link.view.state

    @property
    def control_state(self) -> ControlState:
        """Return the mode, the holder of control, and the flagged problems."""
        self._catch_up()
        return self._link.view.control or ControlState(ControlMode.UNDEFINED)

    @property
    def mode(self) -> ControlMode:
        """Return MANUAL or AUTOMATED; UNDEFINED if the scheduler has published no mode."""
        return self.control_state.mode

    @property
    def scan_parameters(self) -> ScanParameters | None:
        """Return region and shape of the next scan; None if the microscope has not published them."""
        self._catch_up()
        return self._link.view.scan_parameters

    @property
    def feedback(self) -> Feedback | None:
        """Return the z feedback; None if the microscope has not published it."""
        self._catch_up()
        return self._link.view.feedback

    @property
    def feedback_units(self) -> FeedbackUnits:
        """Return the units of the numbers of `feedback`; empty where the microscope has not published them."""
        self._catch_up()
        return self._link.view.feedback_units

    def settings_of(self, scan: Scan | None = None) -> dict[str, str]:
        """Return the bias, setpoint, speed and gains that a scan has stated, as `settings` of one to compare with it.

        Args:
            scan: None: the newest measurement.

        Returns:
            Empty if it has stated none, or its conditions are not known any more.
        """
        self._catch_up()
        found = self._link.view.conditions_of(scan)
        return {} if found is None else settings_to_lend(in_force(found.begin_values, found.end_values))

    @property
    def tip(self) -> TipStatus | None:
        """Return whether tip and feedback are at work, as the controller reports; None if it has reported nothing."""
        self._catch_up()
        return self._link.view.tip

    @property
    def channels(self) -> ChannelRoles:
        """Return the microscope's channels by their roles, also after the end; empty if it has declared none."""
        with suppress(ExperimentEnded, StopRequested):
            self._catch_up()
        return self._link.view.channels

    @property
    def probe_position(self) -> ProbePosition | None:
        """Return the position of the probe; None if the microscope has not published it."""
        self._catch_up()
        return self._link.view.probe_position

    @checked_call
    def events(self, *envelopes: str, timeout_s: float | None = None) -> Events:
        """Iterate over messages published from now on, as `PublishedEvent(envelope, message, time_ns)`.

        Args:
            envelopes: prefixes of the wanted envelopes; none: all.
            timeout_s: end the iteration after this real time without a message; None: only with the experiment.

        Raises:
            InvalidValue: an envelope is not a text, or begins with no known message's name.
        """
        for envelope in envelopes:
            _check_prefix(envelope)
        if self._link.is_caught_up():
            with suppress(ExperimentEnded), self._link.interrupts.heeded():
                self._link.take_in()  # else packets of long ago, which wait unread, would count as new
        return Events(self._link, envelopes, timeout_s, self._before_wait)

    @checked_call
    def wait_until(self, condition: Callable[[], bool], *, timeout_s: float | None = None) -> bool:
        """Wait until `condition()`, tested after each event; return False after `timeout_s` of real time."""
        with self._call():
            self._before_wait()
            return self._link.wait(condition, self._link.until(timeout_s))

    def sleep(self, experiment_s: float) -> None:
        """Wait for some experiment time; unlike `time.sleep`, the wait follows the experiment's clock.

        Raises:
            InvalidValue: the time is not a number, or below zero.
            ExperimentEnded: the experiment has ended.
        """
        if not (is_number(experiment_s) and experiment_s >= 0.0):
            raise InvalidValue(f"can't wait for {experiment_s!r}", hint="a number of seconds, zero or more")
        clock = self._link.clock
        end_s = clock.now_s() + experiment_s
        with self._call(), clock.late(end_s):
            self._before_wait()
            while (left_s := end_s - clock.now_s()) > 0.0:
                self._link.wait(lambda: False, self._link.until(clock.real_s(left_s)))

    @checked_call
    def is_flagged(self, problem: int | str) -> bool:
        """Return whether a problem, by name or number, is flagged."""
        return self.problems.number(problem) in self.control_state.problems

    def _before_wait(self) -> None:
        """Prepare for a wait that is no part of a request or measurement."""

    @contextmanager
    def _call(self) -> Iterator[None]:
        # after the outermost call, handle the packets that arrived during it
        self._link.check()
        self._depth += 1
        try:
            with self._link.interrupts.heeded():
                yield
        finally:
            self._depth -= 1
        if self._depth == 0:
            self._between()

    def _catch_up(self) -> None:
        # a long computation may lie between two calls: take in the packets that arrived since
        with self._link.interrupts.heeded():
            self._link.wait_caught_up()
            self._link.take_in()


def _check_prefix(envelope: object) -> None:
    if not isinstance(envelope, str):
        hint = 'give each as an argument: events("Scan2d", "Spec1d")'
        raise InvalidValue(f"an envelope is a text, not {envelope!r}", where="events", hint=hint)
    names = wire.known_messages()
    if not any(name.startswith(envelope) or envelope.startswith(name) for name in names):
        hint = "e.g. Scan2d, Spec1d or ScopeStateMsg; messages of your own need their module under `messages`"
        raise InvalidValue(f"no envelope begins with {envelope!r}", where="events", hint=hint)
