"""Observation of the controller: every change, by a request or at the panel, is published."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

from afspm import wire
from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import AfspmError, InvalidValue, Refused
from afspm.basics.shared_time import Publication
from afspm.model import (
    ActByHand,
    ChannelRoles,
    ControlRequest,
    MeasurementConditions,
    PanelAct,
    Parameter,
    Request,
    ScopeState,
    ScopeStatus,
    TipStatus,
    names,
)
from afspm.model.microscope_status import feedback_of
from afspm.model.state import MEASURING, FeedbackUnits
from afspm.storage.disk import is_full
from afspm.translator import setting_groups
from afspm.translator.claims import Claims
from afspm.translator.driver_base import LOST, Action, DriverBase
from afspm.translator.outbox import Outbox, Outgoing
from afspm.translator.panel_watch import EXTRA, PanelWatch
from afspm.translator.parameters import FEEDBACK_ON, Value
from afspm.translator.polling import AdaptivePolling, OverdueScan
from afspm.translator.sequence import DiscardResults, LogError, PublishResults, PublishStatus, SequenceStep
from afspm.translator.state import TranslatorState
from afspm.translator.temporary_settings import TemporarySettings
from afspm.translator.wished_feedback import FeedbackLevel, WishedFeedback
from afspm.transport.port import ServerPort

_TIP = (names.ENGAGED, FEEDBACK_ON)
_GAINS = (names.ZCTRL_PGAIN, names.ZCTRL_IGAIN)
_AGAIN_S = 0.1
"""Real time until the feedback is read again, once it was found off though on is wished."""
_SELDOM_S = 1.0
"""Real time: the longest one without a reading of all settings, in a series of short measurements."""
_ROUNDING_S = 1e-5
"""More than the rounding of an experiment time, which has 16 digits since 1970."""


class Observer:
    """An observer that reads values, status and results of the controller, and publishes them in order.

    Attributes:
        values: values at the last reading.
        panel: what was done at the microscope by hand.
        claims: what the running measurement stands for.
    """

    def __init__(
        self,
        driver: DriverBase,
        port: ServerPort,
        state: TranslatorState,
        temporary: TemporarySettings,
        log: logging.Logger,
    ) -> None:
        self._driver = driver
        self._port = port
        self._clock = port.clock
        self._state = state
        self._temporary = temporary
        self._log = log
        self._outbox = Outbox(driver, state.kept["outbox"], state.stamp, log)
        self._polling = AdaptivePolling(driver.common.poll_period_s, driver.eager_poll_s)
        self._live = LiveLines(driver)
        self._unreadable = self._refused = ""
        self.values: dict[str, Value] = {}
        self._told: dict[str, Value] = {}
        # of real time at least, for an emulated controller
        slow = max(1.0, 1.0 / self._clock.real_s(1.0))
        feedback = WishedFeedback(state.kept, slow * driver.settles_s, follows=driver.only_reads)
        self.panel = PanelWatch(state.kept, driver.table, driver.is_last_written, feedback, slow * driver.leaves_tip_s)
        self.claims = Claims(driver, state.kept)
        self._unproved: Sequence[str] = ()
        self._is_after_spectrum = False
        self._published_last: dict[type, object] = {}
        self._acts: list[ActByHand] = []
        self._others_reported = False
        self._polled_for = ScopeState.UNDEFINED
        self._all_at_s = self._all_read_s = 0.0
        self._result_since_s: float | None = None
        self._replayed = False
        self._overdue = OverdueScan()
        self._is_unsettled = False
        self._settled_s: float | None = None

    def begin(self) -> None:
        """Publish the last results again (once, after a restart), then all settings and the state.

        Temporary settings of an earlier process or connection are restored before the settings are read.
        """
        if not self._replayed:
            self._replayed = True
            for packet in self._outbox.start():
                self._port.publish(*packet)
            self._state.save()
        self._temporary.end()  # impossible before a kill, or while the controller was lost
        self.panel.lost()
        if self._state.sequence.published.state is ScopeState.SPEC:  # it may have ended meanwhile
            self._is_after_spectrum = True
            self.panel.feedback.held(self._clock.now_s())
        self._take_in(self._read())
        self._told = self._as_told()
        acts = self.panel.read({}, self.values, ScopeState.UNDEFINED, self._clock.now_ns(), self._driver.withdrew_tip())
        self.publish_all()
        self._report(acts)

    def look(self) -> None:
        """Read the controller, and publish the changes since the last reading."""
        published = self._state.sequence.published
        self._temporary.end_if_due()
        if self.reads_settings:
            self.observe()
        elif (status := self._status()) != published:
            # the end of a measurement changes no setting; any other change of state may
            self.observe(values=published.state not in MEASURING, status=status)
        if overdue := self._overdue.look(self._clock.monotonic_s(), self._expected_s):
            self._log.critical("%s", overdue)
        for name, payload in self._new_lines():
            self._port.publish(name, payload, self._state.stamp()[0], keep=False)
            self._clock.published(Publication.LINES)

    def _new_lines(self) -> list[tuple[str, bytes]]:
        try:
            lines = self._live.look(self._clock.now_s())
        except LOST:
            raise
        except Exception as error:  # a driver may raise anything: without its lines the scan itself is as good
            self._live.end()
            if str(error) != self._unreadable:  # a night may have hundreds of such scans
                self._unreadable = str(error)
                self._log.error("no more lines of this scan are published, since they can't be read: %s", error)
            return []
        if lines:
            self._unreadable = ""
        return lines

    def wait_s(self) -> float:
        """Return the real seconds until the next reading is due."""
        real_now_s, now_s = self._clock.monotonic_s(), self._clock.now_s()
        polling_s = self._polling.wait_s(real_now_s, end_is_reported=self._driver.reports_end())
        wait_s = min(polling_s, self._all_at_s - real_now_s)
        if self.panel.feedback.is_in_question:
            wait_s = min(wait_s, _AGAIN_S)
        sequence_s = self._state.sequence.deadline_s()
        of_driver = (self._driver.next_change_s(), self._settled_s)
        for at_s in (*of_driver, sequence_s, self._live.due_s, self._temporary.until_s):
            if at_s is not None:
                # an overdue change is polled for eagerly, but with a pause: the controller has other work
                until_s = self._clock.real_s(at_s - now_s)
                wait_s = min(wait_s, until_s if until_s > 0.0 else self._driver.eager_poll_s)
        return max(0.0, wait_s)

    def late_at_change(self) -> AbstractContextManager[None]:
        """Return a context that holds simulated time at the driver's next change, or when awaited lines are due."""
        now_s = self._clock.now_s()
        due = (self._driver.next_change_s(), self._live.awaited_s, self._settled_s)
        at_s = min((one for one in due if one is not None and one > now_s), default=None)
        return nullcontext() if at_s is None else self._clock.late(at_s)

    @property
    def reads_settings(self) -> bool:
        """True if a look now reads all settings; otherwise it reads the state alone."""
        return self._clock.monotonic_s() >= self._all_at_s

    def idle_until_s(self) -> float:
        """Return the real time until which a look does nothing, provided that the controller answers as before.

        The time may be some microseconds early; it has passed if a look may do something now.
        """
        waits_for = (self._state.sequence.deadline_s(), self._temporary.until_s, self._result_since_s, self._settled_s)
        if any(one is not None for one in waits_for) or self._is_unsettled or self.panel.feedback.is_in_question:
            return -math.inf
        due_s = self._live.due_s
        lines_s = math.inf if due_s is None else self.real_time_s(due_s)
        return min(lines_s, self._overdue.due_s)

    def real_time_s(self, at_s: float) -> float:
        """Return the real monotonic time of an experiment time, or some microseconds earlier."""
        return self._clock.monotonic_s() + self._clock.real_s(at_s - self._clock.now_s()) - _ROUNDING_S

    def skip_look(self) -> None:
        """Plan the next look as after a look that found no change, for a bench that knows that there is none."""
        if self.reads_settings:
            self._plan_reading()

    def observe(self, announce: Sequence[str] = (), *, values: bool = True, status: ScopeStatus | None = None) -> None:
        """Publish all changes.

        Args:
            announce: messages to publish even if unchanged.
            values: False leaves out the settings, whose reading takes a question for each parameter.
            status: the status just read, since a driver reports an interruption only once; None: read the status now.
        """
        before, sequence = self.values, self._state.sequence
        if values:
            self._observe_values(announce)
        # the state first: a result that appears in between waits for the next look, and is not lost
        status = self._status() if status is None else status
        is_over = sequence.published.state in MEASURING and status.state not in MEASURING
        if is_over:
            self._polling.over(self._clock.monotonic_s())
        gives_back = self._is_after_spectrum and status.state is ScopeState.FREE
        if is_over or gives_back:
            # after the state: the tip may have been withdrawn between the reading of the values and the end. The values
            # that the result stands for are read by its verdict, values that a spectrum has swept here, before they
            # could be taken for a person's, and all others by the next look.
            if changed := self._changed(*_TIP, *self.panel.swept(self.values)):
                self._take_in_and_publish({**self.values, **changed})
            values = True
        if values:
            withdrew = self._driver.withdrew_tip()
            state = self._of_controller(status.state)
            acts = self.panel.read(before, self.values, state, self._clock.now_ns(), withdrew)
            if self._result_since_s is not None and any(map(self._spoils, acts)):
                self._publish_earlier_scan()
            self._report(acts)
            self._judge_feedback()
        if gives_back and self.panel.feedback.level is FeedbackLevel.HELD:
            return  # what follows would move a tip without feedback: the microscope is free once it is given back
        was, is_requested = sequence.published, sequence.is_requested
        # a fast simulated clock waits here: otherwise much experiment time would pass before the results are published
        with self._clock.late() if is_over else nullcontext():
            results = self._outbox.look()
            is_whole = True if self._is_of_earlier_scan(status, results) else self._driver.followed()
            steps = [] if is_whole is None else self._state.sequence.follow(is_whole=is_whole)
            is_followed = bool(steps)
            of_another = not self._outbox.is_of(was.state)
            steps += sequence.observe(status, results and not steps, self._clock.now_s(), of_another=of_another)
            self._report(self._acts_shown_by(steps, was, is_requested=is_requested))
            self.play(self._without_spoiled(steps, is_at_end=not is_followed))
            if is_over and sequence.published.state not in MEASURING:
                self._clock.published(Publication.RESULTS)
        # only now: a free microscope whose result is awaited, or whose scan this look shows to have ended, is no proof
        self.panel.is_certain = self.panel.is_certain or sequence.published.state is ScopeState.FREE

    def _is_of_earlier_scan(self, status: ScopeStatus, results: bool) -> bool:
        # A controller that repeats scans at the panel may never be free: a result that has waited for long during a
        # scan is of the scan before. Otherwise the result would wait for the end of the last scan, and be lost if that
        # scan is stopped. A requested scan is not repeated: then the controller shows the end late.
        sequence, now_s = self._state.sequence, self._clock.now_s()
        is_scanning = status.state is sequence.published.state is ScopeState.SCANNING
        if not (results and is_scanning) or sequence.is_requested:
            self._result_since_s = None
            return False
        if self._result_since_s is None:
            self._result_since_s = now_s
        return now_s - self._result_since_s >= self._driver.patience_s(self._driver.common.result_timeout_s / 2)

    def _publish_earlier_scan(self) -> None:
        # A panel that repeats scans: the waiting result was complete before the act, which ended the scan after it.
        sequence, running = self._state.sequence, self._state.sequence.published
        self._result_since_s = None
        steps = [*sequence.follow(is_whole=True), *sequence.observe(running, results=False, now_s=self._clock.now_s())]
        self.play(self._without_spoiled(steps, is_at_end=False))

    def asked(self, request: Request, action: Action | None) -> None:
        """Note that a request of the run is about to change something.

        Args:
            action: the action that it asks for, if it asks for one.
        """
        sets: Sequence[str] | None = setting_groups.FRAME if request.kind == ControlRequest.SET_SCAN_PARAMS else None
        if isinstance(request.subject, Parameter):
            sets = (request.subject.name,)
        name = "" if action is None else action.name
        if name == names.RETRACT:
            self._is_unsettled, self._settled_s = False, None
        self.panel.asked(name, sets=sets)
        feedback = feedback_of(request)
        switches = action.switches_feedback if action else feedback is not None and feedback.on is not None
        self.panel.feedback.asked(name, self._clock.now_s(), switches=switches)
        self._others_reported = False

    def look_before_start(self, request: Request) -> None:
        """Publish all changes, and what a person has just done to the tip, before a measurement is begun."""
        frame = setting_groups.FRAME if request.subject == names.START_SCAN else ()
        before, is_changed = self.values, bool(self._changed(*_TIP, *frame))
        self.observe(values=is_changed)
        if not is_changed:  # the same reading again is a second one
            state = self._of_controller(self._state.sequence.published.state)
            acts = self.panel.read(before, self.values, state, self._clock.now_ns())
            self._report(acts)
        self.claims.asks(request, self.values)

    def is_set(self, values: Mapping[str, Value]) -> None:
        """Note the values that a request of the run has set, as read back."""
        self.claims.is_set(values)
        if self._driver.common.settle_before_scan_s and setting_groups.moves_scanner(self.values, values):
            self._is_unsettled, self._settled_s = True, None

    def _judge_feedback(self) -> None:
        # of a measurement of the run: what a person measures by hand is his own
        feedback = self.panel.feedback
        if feedback.news:
            self._log.warning("%s", feedback.news)
            feedback.news = ""
        if not self.claims.is_by_run or self._state.kept.get("spoiled"):
            return
        if feedback.level in (FeedbackLevel.OFF, FeedbackLevel.BY_HAND):
            self._spoil(f"the z feedback was found off{feedback.hint}")
        elif feedback.level is FeedbackLevel.ON:
            self._spoil("the z feedback was found on, and the run had switched it off")

    def _spoil(self, why: str) -> None:
        self._state.kept["spoiled"] = why
        self._live.end()
        self._state.save()

    def _acts_shown_by(self, steps: Sequence[SequenceStep], was: ScopeStatus, *, is_requested: bool) -> list[ActByHand]:
        # only changes of state that no request caused: the steps of a request are played apart
        states = [step.status for step in steps if isinstance(step, PublishStatus)]
        if not (states and self.panel.is_certain):
            return []
        now_ns, acts = self._clock.now_ns(), []
        is_explained = bool(self._state.kept.get("spoiled"))  # a tip withdrawn by hand may end the scan as well
        if is_requested and not is_explained and any(one.state is ScopeState.INTERRUPTED for one in states):
            evidence = self._driver.stopped_by_hand()
            acts += [ActByHand(now_ns, PanelAct.STOP, evidence)] if evidence else []
        if is_requested and states[0].paused and not was.paused:
            acts.append(ActByHand(now_ns, PanelAct.PAUSE))
        others = MEASURING - {was.state} if was.state in (ScopeState.FREE, *MEASURING) else ()
        begun = next((one.state for one in states if one.state in others), None)
        if begun is not None and not self._others_reported:
            self._others_reported = True  # a panel that repeats scans would report each
            acts.append(ActByHand(now_ns, PanelAct.SCAN if begun is ScopeState.SCANNING else PanelAct.SPECTRUM))
        return acts

    def _without_spoiled(self, steps: Sequence[SequenceStep], *, is_at_end: bool) -> list[SequenceStep]:
        # what was measured while a person withdrew the tip, or switched the feedback off, is never complete
        if not any(isinstance(step, PublishResults) for step in steps):
            return list(steps)
        spoiled = self._state.kept.get("spoiled")
        if not spoiled:
            # the next scan had begun when the end of this one was seen: the present settings belong to that one
            tip = self.panel.tip if is_at_end else None
            verdict = self.claims.verdict(tip, self._outbox.stated(), withdrew=self._driver.withdrew_tip())
            self._unproved, spoiled = verdict.unproved, verdict.sentence
        if not spoiled:
            return list(steps)
        instead: list[SequenceStep] = [
            LogError(f"the measurement is not published: {spoiled}"),
            PublishStatus(ScopeStatus(ScopeState.INTERRUPTED)),
            DiscardResults(),
        ]
        if self.claims.repeated:
            self._report([ActByHand(self._clock.now_ns(), PanelAct.CONTRADICTION, self.claims.repeated)])
        return [one for step in steps for one in (instead if isinstance(step, PublishResults) else [step])]

    def _report(self, acts: Sequence[ActByHand]) -> None:
        for act in acts:
            self._log.warning("by hand: %s", act)
            if self._state.sequence.published.state in MEASURING:
                self._acts.append(act)
                if self._spoils(act):
                    self._spoil(str(act))
        if acts:
            self._temporary.held.moves_aside()
            self._state.save()
        for act in acts:
            self._port.publish(*wire.encode(act), self._state.stamp()[0])
        self._publish_tip()

    def _spoils(self, act: ActByHand) -> bool:
        # a spectrum may be taken without feedback, and is over when its end is seen to have left it off
        is_scanning = self._state.sequence.published.state is ScopeState.SCANNING
        return act.act is PanelAct.WITHDRAW or (act.act is PanelAct.FEEDBACK_OFF and is_scanning)

    def _publish_channels(self) -> None:
        # at constant height another channel shows the surface
        feedback = setting_groups.feedback(self._told)
        self._publish_change(self._driver.channels.with_topography(feedback_on=feedback.on))

    def _publish_units(self) -> None:
        table = self._driver.table
        gains_and_setpoint = (names.ZCTRL_PGAIN, names.ZCTRL_IGAIN, names.ZCTRL_SETPOINT)
        self._publish_change(
            FeedbackUnits(*(table[name].si_unit if name in table else "" for name in gains_and_setpoint))
        )

    def _publish_tip(self) -> None:
        self._publish_change(self.panel.tip)

    def _publish_change(self, thing: ChannelRoles | FeedbackUnits | TipStatus) -> None:
        kind = type(thing)
        if thing not in (self._published_last.get(kind), kind()):
            self._published_last[kind] = thing
            self._port.publish(*wire.encode(thing), self._state.stamp()[0])

    def _changed(self, *shown: str) -> dict[str, Value]:
        table, old = self._driver.table, self.values
        values = self._driver.in_force([name for name in shown if name in table])
        return {
            name: value for name, value in values.items() if name not in old or not table[name].same(old[name], value)
        }

    def _conditions(self, time_ns: int, filename: str) -> MeasurementConditions:
        return self.claims.conditions(time_ns, filename, self._acts, self._unproved)

    def play(self, steps: Sequence[SequenceStep]) -> None:
        """Carry out the steps of a status sequence: save all their changes at once, then publish.

        A process killed in between publishes the results again, at the same times, before the next state. If that
        state were saved first, a restarted process would publish it without the results, and a component that waits
        for the scan would start it a second time.
        """
        if not steps:
            return
        packets: list[Outgoing] = []
        for step in steps:
            if isinstance(step, PublishStatus):
                packets.append(packet := self._packet(step.status))
                self._note_state(step.status.state, packet.time_ns)
            elif isinstance(step, PublishResults):
                packets += self._outbox.take(self._conditions)
            elif isinstance(step, DiscardResults):
                self._outbox.discard()
            elif isinstance(step, LogError):
                why = f"; the disk of {self._driver.run_dir} is full" if is_full(self._driver.run_dir) else ""
                self._log.error("%s%s", step.text, why)
        self._state.save()
        for packet in packets:
            self._port.publish(*packet)
        for step in steps:
            if isinstance(step, PublishStatus):
                self._adapt_polling(step.status.state)

    def _note_state(self, state: ScopeState, time_ns: int) -> None:
        if state in MEASURING and self.claims.running is None:
            self.claims.begin(time_ns, self.panel.tip, state, self.values)
            self._is_after_spectrum = state is ScopeState.SPEC
            self._acts = []
        elif state is ScopeState.FREE:
            self.claims.end()
            self._state.kept.pop("spoiled", None)
            self._is_after_spectrum, self._acts = False, []

    def publish_all(self) -> None:
        """Publish the present settings and the published state again, for a newly connected scheduler."""
        for thing in setting_groups.messages(self._told).values():
            self.publish(thing)
        self._published_last.clear()
        self._publish_channels()
        self._publish_units()
        self._publish_tip()
        published = self._state.sequence.published
        if published.state is not ScopeState.UNDEFINED:
            self.publish(published)
        # its start is not known: it may end soon
        if published.state in MEASURING and self._polled_for not in MEASURING:
            self._polled_for = published.state
            self._polling.began(object(), self._clock.monotonic_s())
            # of an earlier process: its lines come again, from the first
            if published.state is ScopeState.SCANNING and not self._state.kept.get("spoiled"):
                self._live.begin(self._clock.now_ns(), self._expected_scan()[0])

    def publish(self, thing: setting_groups.Published | ScopeStatus) -> None:
        self._port.publish(*self._packet(thing))

    def _packet(self, thing: setting_groups.Published | ScopeStatus) -> Outgoing:
        return Outgoing(*wire.encode(thing), self._state.stamp()[0])

    def _status(self) -> ScopeStatus:
        # while temporary settings are in force the microscope counts as busy, even if the controller reports FREE
        status = self._temporary.status or self._driver.status()
        if not self._is_unsettled or status.state is not ScopeState.FREE:
            return status
        now_s = self._clock.now_s()
        if self._settled_s is None:  # the controller has just finished the move
            self._settled_s = now_s + self._driver.common.settle_before_scan_s
        if now_s < self._settled_s:
            return ScopeStatus(ScopeState.MOVING)
        self._is_unsettled, self._settled_s = False, None
        return status

    def _of_controller(self, state: ScopeState) -> ScopeState:
        # while the scanner settles the controller itself is free, and a person's changes are seen as between scans
        return ScopeState.FREE if state is ScopeState.MOVING and self._settled_s is not None else state

    def _observe_values(self, announce: Sequence[str]) -> None:
        self._take_in_and_publish(self._read(), announce)
        self._plan_reading()

    def _take_in_and_publish(self, values: dict[str, Value], announce: Sequence[str] = ()) -> None:
        self._take_in(values)
        old, self._told = self._told, self._as_told()
        if announce or self._told != old:
            self._publish_channels()
            before = setting_groups.messages(old)
            for name, thing in setting_groups.messages(self._told).items():
                if name in announce or before.get(name) != thing:
                    self.publish(thing)

    def _plan_reading(self) -> None:
        self._all_read_s = self._clock.monotonic_s()
        wait_s, next_s = self._driver.common.poll_period_s, self._driver.next_change_s()
        if self.panel.feedback.is_in_question:
            wait_s = min(wait_s, _AGAIN_S)
        if next_s is not None:
            wait_s = min(wait_s, max(0.0, self._clock.real_s(next_s - self._clock.now_s())))
        self._all_at_s = self._clock.monotonic_s() + wait_s

    def _read(self) -> dict[str, Value]:
        # a difference below the controller's resolution is no change
        table, old = self._driver.table, self.values
        extra = [name for name in EXTRA if name in table]
        vital = [name for name in setting_groups.watched(table) if name not in _GAINS]
        others = [*(name for name in _GAINS if name in table), *extra, *table.watched]
        try:
            values = self._driver.in_force([*vital, *others])
        except (InvalidValue, Refused) as error:  # lost only if nothing can be measured without the value
            if str(error) != self._refused:
                self._refused = str(error)
                self._log.warning("settings that are watched can't be read: %s", error)
            values = self._driver.in_force(vital) | self._driver.reported(others)
        return {
            name: old[name] if name in old and table[name].same(old[name], value) else value
            for name, value in values.items()
        }

    def _as_told(self) -> dict[str, Value]:
        # a feedback that the controller itself holds in a spectrum, and gives back, is on for others
        feedback = self.panel.feedback
        may_hold = self._state.sequence.published.state is ScopeState.SPEC or feedback.level is FeedbackLevel.HELD
        if may_hold and feedback.wished and self.values.get(FEEDBACK_ON) is False:
            return {**self.values, FEEDBACK_ON: True}
        return self.values

    def _take_in(self, values: dict[str, Value]) -> None:
        self.values = values
        if self._state.feedback.saw(setting_groups.feedback(values).on):
            self._state.save()

    def _adapt_polling(self, state: ScopeState) -> None:
        before, self._polled_for, now_s = self._polled_for, state, self._clock.monotonic_s()
        if over := self._overdue.state_changed(now_s, is_scanning=state is ScopeState.SCANNING):
            self._log.info("%s", over)
        lasts_s, extent = self._expected_scan() if state is ScopeState.SCANNING else (None, ())
        if state is not ScopeState.SCANNING:
            self._live.end()
        elif before is not ScopeState.SCANNING:  # a pause and its end are published too, during the same scan
            self._live.begin(self._clock.now_ns(), lasts_s)
        if state in MEASURING:
            self._polling.began((state, *extent), now_s, lasts_s)
        elif state in (ScopeState.FREE, ScopeState.UNDEFINED):
            self._polling.ended(now_s, as_expected=state is ScopeState.FREE and before in MEASURING)
            if before in MEASURING:
                # the next scan is asked for at once, and would wait for a dozen questions about values
                period_s = self._driver.common.poll_period_s
                latest_s = self._all_read_s + max(_SELDOM_S, period_s)
                self._all_at_s = min(max(self._all_at_s, now_s + period_s), latest_s)
        else:
            self._polling.moved(now_s)

    def _expected_s(self) -> float | None:
        # a person may have made the scan slower since its start; a retrace may be slower than the settings show
        known = [one for one in (self._polling.expected_s, self._expected_scan()[0]) if one is not None]
        return max(known, default=None)

    def _expected_scan(self) -> tuple[float | None, tuple[Value, ...]]:
        # a lower bound: the time lost at the edges of a scan is not known
        extent = tuple(self.values.get(name, 0.0) for name in setting_groups.EXTENT)
        with contextlib.suppress(*LOST, AfspmError, ArithmeticError):
            if all(extent) and names.SCAN_SPEED in self._driver.table:
                speed_m_s = float(self._driver.in_force([names.SCAN_SPEED])[names.SCAN_SPEED])
                width_m, rows = float(extent[0]), float(extent[1])
                return self._clock.real_s(2.0 * width_m * rows / speed_m_s), (*extent, speed_m_s)
        return None, extent


_READINGS = 16
"""Number of readings during a scan if simulated time waits for a receiver of lines. The interval by real time may be
longer than a scan: 10 min of experiment time at a speed of 1,200."""


class LiveLines:
    """A reader of new lines of the running scan. Times are in experiment seconds.

    Args:
        microscope: its `live_lines_s` sets the interval between readings of lines; otherwise the interval is its
            `live_real_s`, or shorter if simulated time waits for a receiver of lines.
    """

    def __init__(self, microscope: DriverBase) -> None:
        self._microscope, self._clock = microscope, microscope.clock
        given_s, real_s = microscope.common.live_lines_s, microscope.live_real_s
        self._is_given = given_s is not None
        # None: never
        self._usual_s = (given_s or None) if self._is_given or real_s is None else real_s / self._clock.real_s(1.0)
        self._lasts_s: float | None = None
        self._is_awaited = False
        self._began_ns = 0
        self._lines = 0
        self.due_s: float | None = None
        """Time of the next `look`; None until another scan begins."""

    @property
    def awaited_s(self) -> float | None:
        """Time of the next `look` if simulated time waits for a receiver of lines."""
        return self.due_s if self._is_awaited else None

    def begin(self, now_ns: int, lasts_s: float | None = None) -> None:
        """Start reading the lines of a new scan.

        Args:
            lasts_s: expected duration of the scan in real seconds; None: unknown.
        """
        if self._usual_s is not None:
            self._began_ns, self._lines = now_ns, 0
            self._lasts_s = None if lasts_s is None else lasts_s / self._clock.real_s(1.0)
            self._plan(now_ns / NS_PER_S)

    def _plan(self, now_s: float) -> None:
        assert self._usual_s is not None
        # kept once true: the receiver withdraws its hold for a moment after each publication
        self._is_awaited = self._is_awaited or self._clock.awaits(Publication.LINES)
        every_s = self._usual_s
        if self._is_awaited and self._lasts_s is not None and not self._is_given:
            # the half: the last reading is before the end
            every_s = min(every_s, self._lasts_s / (_READINGS + 0.5))
        self.due_s = now_s + every_s

    def end(self) -> None:
        """Stop reading lines, at the end of the scan."""
        self.due_s = None

    def look(self, now_s: float) -> list[tuple[str, bytes]]:
        """Return messages with the new lines; empty before `due_s` or without new lines."""
        if self.due_s is None or now_s < self.due_s:
            return []
        self._plan(now_s)
        new = self._microscope.lines(self._lines)
        self._lines += max((len(lines.values) for lines in new), default=0)
        return [wire.encode(replace(lines, began_ns=self._began_ns)) for lines in new if len(lines.values)]
