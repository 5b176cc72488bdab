"""The invariants of the tip, of roles and of the end, in any simulated night."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from afspm.model import ControlMode, ControlRequest, Parameter, Problem, Request, names
from afspm.scheduler.control.arbitration import ArbitrationState
from afspm.scheduler.events import Effect, Input, Kill, Log, PacketIn, Reply, RequestIn
from afspm.scheduler.publishing.event_log import SCHEDULER
from afspm.scheduler.settings import SchedulerSettings
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_time import SimulatedTime
from tests.simulation.microscope import FakeMicroscope

_MALFUNCTION = Problem.DEVICE_MALFUNCTION
_OF_CONTROL = range(int(ControlRequest.REQUEST_CTRL), int(ControlRequest.END_EXPERIMENT) + 1)
_SLACK_S = 1.0


class TipSafety:
    """Observes the controller itself, and the right to command it.

    A tip is unattended from the moment that its holder loses control without releasing it, until a person takes over, a
    component gets control to solve the malfunction, or the next holder gets control with the tip out of danger.

    Attributes:
        retractions: how often the scheduler withdrew the tip.
        dangers: how often a tip was unattended in danger.
        is_safe_at_the_end: what the scheduler knew of the tip when it ended the experiment; False before.
        must_close: True if the translator must have been closed after the end: it was there, and the tip safe.

    Args:
        must: raises a violation if a condition does not hold.
    """

    def __init__(
        self,
        timeline: SimulatedTime,
        settings: SchedulerSettings,
        microscope: FakeMicroscope,
        must: Callable[[bool, str], None],
    ) -> None:
        self._timeline = timeline
        self._settings = settings
        self._microscope = microscope
        self._must = must
        self._before = ArbitrationState()
        self._unattended = False
        self._danger_since_s: float | None = None
        self._disturbed_until_s = -1.0
        self._is_told = False
        self._safe_since_s = self._ended_s = -1.0
        self.retractions = 0
        self.dangers = 0
        self.is_safe_at_the_end = self.must_close = False
        microscope.on_closed = self._closed
        self.memory_is_certain = True
        self._by_hand = False
        self._life = 0

    def disturbed(self, for_s: float) -> None:
        """Note that scheduler, microscope or the connection between them do not work for a time."""
        self._disturbed_until_s = max(self._disturbed_until_s, self._timeline.monotonic_s() + for_s)

    def stepped(self, host: SchedulerHost, event: Input | None, effects: Sequence[Effect]) -> None:
        """Check the state after a step of the scheduler."""
        if host.life != self._life:  # it may have been killed before what it had decided was seen
            self._life, self._before = host.life, host.core.control
            self._unattended = self._unattended and self.memory_is_certain
        self._forget_told()
        before, after = self._before, host.core.control
        self._by_hand = isinstance(event, PacketIn) and after.mode is ControlMode.MANUAL
        if after is not before:
            self._changed(before, after, _who(event, effects))
            self._before = after
        for effect in effects:
            if isinstance(effect, Log):
                if effect.level == "CRITICAL" or (effect.level == "WARNING" and after is not before):
                    self._is_told, self._safe_since_s = True, self._timeline.monotonic_s()
            elif isinstance(effect, Kill):
                self._ends(host, tip_is_safe=effect.tip_is_safe)
        self._look(host)

    def _closed(self) -> None:
        # a translator that is closed does not retract by itself: with a tip in danger it must be left to its parent
        self._must(self.is_safe_at_the_end, "the translator was closed with the tip in danger")

    def _ends(self, host: SchedulerHost, *, tip_is_safe: bool) -> None:
        self.is_safe_at_the_end = tip_is_safe
        self.must_close = tip_is_safe and not self._is_disturbed(host)
        # the experiment waits for the tip, and logs an end with the tip in danger
        microscope, now_s = self._microscope, self._timeline.monotonic_s()
        if not (self._unattended and microscope.endangers_tip and microscope.habits.retracts):
            return
        has_waited = not tip_is_safe and now_s - self._ended_s >= self._settings.control.request_timeout_s
        self._must(has_waited or self._is_disturbed(host), "the experiment ended with the tip in danger")

    def _forget_told(self) -> None:
        # a warning holds for one danger; a command on its way may cause another later
        now_s, settings = self._timeline.monotonic_s(), self._settings
        if self._microscope.endangers_tip:
            self._safe_since_s = now_s
        elif now_s - self._safe_since_s > settings.control.request_timeout_s + settings.waits.answer_s:
            self._is_told = False

    def _changed(self, before: ArbitrationState, after: ArbitrationState, who: str) -> None:
        self._roles(before, after, who)
        if after.mode is ControlMode.MANUAL or (after.holder is not None and after.solving == _MALFUNCTION):
            self._unattended = False
        elif after.holder is not None and after.holder != before.holder:
            self._unattended = self._unattended and self._microscope.endangers_tip
        elif (before.holder is not None and after.holder is None and who != before.holder) or after.ended:
            self._unattended = True

    def _roles(self, before: ArbitrationState, after: ArbitrationState, who: str) -> None:
        roles = self._settings.rules.roles
        if after.mode is not before.mode and not self._by_hand:
            self._must(who in (roles.set_mode or ()), f"{who or 'nobody'} switched the mode")
        if after.ended and not before.ended:
            self._ended_s = self._timeline.monotonic_s()
            self._must(who in (roles.end_experiment or ()), f"{who or 'nobody'} ended the experiment")
        if before.problems.get(_MALFUNCTION) == SCHEDULER and _MALFUNCTION not in after.problems:
            may = who in (roles.clear_problems or ()) or (who == before.holder and before.solving == _MALFUNCTION)
            self._must(may, f"{who or 'nobody'} cleared the malfunction that only a person may")

    def _look(self, host: SchedulerHost) -> None:
        # a tip left in danger is withdrawn soon, or people are warned
        now_s = self._timeline.monotonic_s()
        if not (self._unattended and self._microscope.endangers_tip):
            self._danger_since_s = None
            return
        if self._danger_since_s is None:
            self._danger_since_s = now_s
            self.dangers += 1
        if self._is_disturbed(host) or host.core.control.ended:
            return
        settings = self._settings
        since_s = max(self._danger_since_s, host.since_s, self._microscope.since_s, self._disturbed_until_s)
        answered_s = settings.control.request_timeout_s + settings.waits.answer_s
        allowed_s = answered_s + settings.watchdog.longest_s + _SLACK_S
        is_in_time = now_s - since_s <= (_SLACK_S if not self._microscope.habits.retracts else allowed_s)
        self._must(
            self._is_told or is_in_time, f"the tip has been in danger for {now_s - since_s:.1f} s, and nobody was told"
        )
        if self._microscope.habits.retracts:
            self._must(now_s - since_s <= 3 * allowed_s, f"the tip has been in danger for {now_s - since_s:.1f} s")

    def _is_disturbed(self, host: SchedulerHost) -> bool:
        microscope = self._microscope
        there = microscope.alive and not microscope.frozen and host.alive and not host.frozen
        return not there or self._timeline.monotonic_s() < self._disturbed_until_s

    def executed(self, request: Request) -> None:
        """Check a command before the microscope executes it."""
        subject = request.subject
        if subject == names.RETRACT and not request.id:
            self.retractions += 1
        if request.kind == ControlRequest.ACTION and subject in (names.START_SCAN, names.START_SPEC):
            panel = self._microscope.panel  # where it does not show the tip, a person may let the run continue too soon
            shows_tip = panel is None or panel.shows_tip
            away = shows_tip and self._microscope.tip_is_away and self._timeline.monotonic_s() > self._disturbed_until_s
            # what the disk had not taken when the scheduler was killed is forgotten, a retraction too
            self._must(not (away and self.memory_is_certain), "a measurement was begun with the tip withdrawn")
        if isinstance(subject, Parameter) and subject.value is not None:
            self._within_limits(subject)
        limit = self._settings.limits.actions.get(str(subject)) if request.kind == ControlRequest.ACTION else None
        if limit is not None and limit.only is not None and request.id:
            who = request.id.split("/")[0]
            self._must(who in limit.only, f"{who} did {subject}, which only {limit.only} may")

    def _within_limits(self, parameter: Parameter) -> None:
        limit = self._settings.limits.parameters.get(parameter.name)
        if limit is None or parameter.value is None:
            return
        value = float(parameter.value)
        within = (limit.low is None or value >= limit.low) and (limit.high is None or value <= limit.high)
        self._must(within, f"{parameter.name} was set to {value:g}, outside of its limits")


def _who(event: Input | None, effects: Sequence[Effect]) -> str:
    # a request that waited for the scheduler's start is answered on a tick
    if isinstance(event, RequestIn):
        return event.name
    return next((effect.name for effect in effects if isinstance(effect, Reply) and effect.asked in _OF_CONTROL), "")
