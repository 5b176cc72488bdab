"""Looking at an experiment: what the microscope does, what is in force, what is published."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from numbers import Real

from afspm.basics.errors import AfspmError, InvalidValue
from afspm.client.events import Events
from afspm.client.experiment_link import ExperimentLink
from afspm.model import (
    ControlMode,
    ControlState,
    Feedback,
    ProbePosition,
    ProblemNames,
    ScanParameters,
    ScopeState,
)


class ExperimentView:
    """The part of `Scope` that asks for nothing.

    Args:
        between: called after each outermost call, when nothing is under way.
    """

    def __init__(self, link: ExperimentLink, problems: ProblemNames, between: Callable[[], None]) -> None:
        self._link = link
        self._between = between
        self._depth = 0
        self.problems = problems

    def __repr__(self) -> str:
        with suppress(AfspmError):  # after the end, say, it tells what was known last
            self._catch_up()
        view = self._link.view
        control = view.control or ControlState(ControlMode.UNDEFINED)
        flagged = "".join(f", {self.problems.name(number)} is flagged" for number in control.problems)
        holder = control.holder or "nobody"
        return f"<Scope {self._link.name!r}: {view.state.name}, {control.mode.name}, {holder} is in control{flagged}>"

    @property
    def state(self) -> ScopeState:
        """The state of the microscope."""
        self._catch_up()
        return self._link.view.state

    @property
    def control_state(self) -> ControlState:
        """Mode, holder and problems."""
        self._catch_up()
        return self._link.view.control or ControlState(ControlMode.UNDEFINED)

    @property
    def mode(self) -> ControlMode:
        """MANUAL or AUTOMATED."""
        return self.control_state.mode

    @property
    def scan_parameters(self) -> ScanParameters | None:
        """Region and shape of the next scan; None if the microscope has not said."""
        self._catch_up()
        return self._link.view.scan_parameters

    @property
    def feedback(self) -> Feedback | None:
        """The z feedback; None if the microscope has not said."""
        self._catch_up()
        return self._link.view.feedback

    @property
    def probe_position(self) -> ProbePosition | None:
        """The position of the probe; None if the microscope has not said."""
        self._catch_up()
        return self._link.view.probe_position

    def events(self, *envelopes: str, timeout_s: float | None = None) -> Events:
        """Iterate over what is published from now on, as `PublishedEvent(envelope, message, time_ns)`.

        Args:
            envelopes: prefixes of those wanted; none: all.
            timeout_s: ends the iteration when nothing came for that long.
        """
        return Events(self._link, envelopes, timeout_s)

    def wait_until(self, condition: Callable[[], bool], *, timeout_s: float | None = None) -> bool:
        """Wait until `condition()`, tried whenever something was published; False when the time is up."""
        with self._call():
            return self._link.wait(condition, self._link.until(timeout_s))

    def sleep(self, experiment_s: float) -> None:
        """Let experiment time pass. Unlike `time.sleep` it follows the experiment's clock, and ends with it."""
        if not (isinstance(experiment_s, Real) and experiment_s >= 0.0):
            raise InvalidValue(f"can't wait for {experiment_s!r}", hint="a number of seconds, zero or more")
        clock = self._link.clock
        end_s = clock.now_s() + experiment_s
        with self._call():
            while (left_s := end_s - clock.now_s()) > 0.0:
                self._link.wait(lambda: False, self._link.until(clock.real_s(left_s)))

    def is_flagged(self, problem: int | str) -> bool:
        """Return whether a problem, by name or number, is flagged."""
        return self.problems.number(problem) in self.control_state.problems

    @contextmanager
    def _call(self) -> Iterator[None]:
        """Around each call of the user; when the outermost is done, what arrived meanwhile is handled."""
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
        """Take in what has arrived, so that what is told is not from before the last computation."""
        with self._link.interrupts.heeded():
            self._link.wait_caught_up()
            self._link.pump(0.0)
