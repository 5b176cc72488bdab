"""`ScanHistory`: which measurement has begun when, under whose control, and to which of them a result belongs."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.basics import replace
from afspm.model.panel import MeasurementConditions
from afspm.model.scan import Scan
from afspm.model.spectrum import Spectrum
from afspm.model.state import MEASURING, ControlState, Feedback, ScopeState, ScopeStatus

_KEPT = 4
"""Measurements and conditions that are kept: a result may be published after the next measurement has begun."""


@dataclass(frozen=True)
class BegunMeasurement:
    """A scan or spectrum that has begun.

    Attributes:
        doing: SCANNING or SPEC.
        number: in the history, from 1; 0: its start was not seen.
        began_ns: None: not known.
        control, feedback: at the start; None: not known.
        asked_by: the component that asked for it, as its translator says; empty: not known.
        was_paused: whether it was published as paused.
        ended_ns, channels: of its results so far.
        is_presumed: the state stayed SCANNING after the result before, whose end is taken for the start of this one
            until another SCANNING is published.
    """

    doing: ScopeState
    number: int = 0
    began_ns: int | None = None
    control: ControlState | None = None
    feedback: Feedback | None = None
    asked_by: str = ""
    was_paused: bool = False
    ended_ns: int | None = None
    channels: tuple[str, ...] = ()
    is_presumed: bool = False

    @property
    def holder(self) -> str | None:
        """The component in control at the start; None if no component was, or that is not known."""
        return self.control.holder if self.control else self.asked_by or None


@dataclass(frozen=True)
class ScanHistory:
    """The measurements begun last, reduced from what the scheduler publishes, in the order of publication.

    A start that a translator publishes in the conditions before a result is believed. Without it, as from a foreign
    translator, the start is found in the states:

    - UNDEFINED is no end: a controller that can't be reached goes on. A scan that runs when it can be reached again,
      or when the first state comes, began at an unknown time.
    - SCANNING during a scan, published after a pause or to a restarted scheduler, begins nothing.
    - A result belongs to the newest measurement that began before its end: it may be published after FREE, and after
      the next measurement has begun.
    - If the state stays SCANNING after a result, as at a panel that repeats scans, the next scan begins at its end;
      another SCANNING, if one is published, is its start.

    Attributes:
        control, feedback: the newest.
        begun: the newest measurements, oldest first. One that was interrupted stays, since some translators publish it.
        is_running: whether the last of them still runs.
        count: measurements begun so far.
        is_observed: whether the last state was known, so that a start shows as a change.
        state_ns: the time of the newest state; older ones are repetitions.
        conditions: the newest, with starts as their translator saw them.
    """

    control: ControlState | None = None
    feedback: Feedback | None = None
    begun: tuple[BegunMeasurement, ...] = ()
    is_running: bool = False
    count: int = 0
    is_observed: bool = False
    state_ns: int = -1
    conditions: tuple[MeasurementConditions, ...] = ()

    @property
    def running(self) -> BegunMeasurement | None:
        return self.begun[-1] if self.is_running else None

    def step(self, thing: object, time_ns: int) -> ScanHistory:
        """Return the history after a published message; another message changes nothing.

        Args:
            thing: the decoded message.
            time_ns: its time of publication.
        """
        match thing:
            case ControlState():
                return replace(self, control=thing)
            case Feedback():
                return replace(self, feedback=thing)
            case MeasurementConditions():
                return replace(self, conditions=(*self.conditions, thing)[-_KEPT:])
            case ScopeStatus() if time_ns > self.state_ns:
                return replace(self._after(thing, time_ns), state_ns=time_ns)
            case Scan():
                return self.with_result(ScopeState.SCANNING, time_ns, thing.time_ns, thing.channel)
            case Spectrum():
                return self.with_result(ScopeState.SPEC, time_ns, thing.time_ns)
        return self

    def _after(self, status: ScopeStatus, time_ns: int) -> ScanHistory:
        running, paused = self.running, status.paused is True
        earlier = self.begun[:-1] if running is not None and running.is_presumed else self.begun
        if status.state is ScopeState.UNDEFINED:
            return replace(self, is_observed=False)
        if status.state not in MEASURING:
            return replace(self, begun=earlier, is_running=False, is_observed=True)
        if running is not None and running.doing is status.state and (paused or not running.is_presumed):
            now = replace(running, was_paused=running.was_paused or paused, is_presumed=False)
            return replace(self, begun=(*self.begun[:-1], now), is_observed=True)
        history = replace(self, begun=earlier, is_running=True, is_observed=True)
        return history._begin(status.state, time_ns if self.is_observed else None, was_paused=paused)

    def _begin(
        self, doing: ScopeState, began_ns: int | None, *, was_paused: bool = False, is_presumed: bool = False
    ) -> ScanHistory:
        now = BegunMeasurement(
            doing, self.count + 1, began_ns, self.control, self.feedback, was_paused=was_paused, is_presumed=is_presumed
        )
        return replace(self, begun=(*self.begun, now)[-_KEPT:], count=now.number)

    def with_result(
        self, doing: ScopeState, published_ns: int, measured_ns: int | None, channel: str = ""
    ) -> ScanHistory:
        """Return the history after a result: a spectrum, or a channel of a scan.

        Args:
            doing: the state in which it was measured.
            published_ns, measured_ns: the time of publication, and the end of the measurement if the result has one.
            channel: of a scan.
        """
        found = self._found(doing, published_ns, measured_ns, channel)
        if found is None:
            return self
        ended_ns = published_ns if measured_ns is None else measured_ns
        channels = found.channels if channel in found.channels else (*found.channels, channel)
        with_it = replace(found, ended_ns=ended_ns, channels=channels, is_presumed=False)
        after = replace(self, begun=tuple(with_it if one is found else one for one in self.begun))
        return after._begin(doing, ended_ns, is_presumed=True) if found is self.running else after

    def of(self, result: Scan | Spectrum, published_ns: int) -> BegunMeasurement:
        """Return the measurement of a result."""
        doing, channel = (ScopeState.SCANNING, result.channel) if isinstance(result, Scan) else (ScopeState.SPEC, "")
        found = self._found(doing, published_ns, result.time_ns, channel) or BegunMeasurement(doing)
        for one in reversed(self.conditions):
            if one.is_of(result):
                # who is in control where a scan is first seen need not have begun it
                control = None if one.holder and found.began_ns is None else found.control
                return replace(found, began_ns=one.began_ns or found.began_ns, asked_by=one.holder, control=control)
        return found

    def _found(
        self, doing: ScopeState, published_ns: int, measured_ns: int | None, channel: str
    ) -> BegunMeasurement | None:
        known = [one for one in reversed(self.begun) if one.doing is doing]
        ended_ns = published_ns if measured_ns is None else measured_ns
        if (same := next((one for one in known if one.ended_ns == ended_ns), None)) is not None:
            return same
        if measured_ns is None:  # channels without a time come one after the other
            newest = next((one for one in known if not one.is_presumed), None)
            if newest is not None and newest.channels and channel not in newest.channels:
                return newest
        # a presumed one begins with the end of the one before
        latest_ns = ended_ns - 1
        before = (one for one in known if (one.began_ns or 0) <= (latest_ns if one.is_presumed else ended_ns))
        found = next(before, None)
        # one that has its result already: the start of this one was not seen
        return None if found is None or channel in found.channels else found
