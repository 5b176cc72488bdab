"""Measurement of one scan or spectrum, exactly once, over interruptions and restarts."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC
from typing import Any

from afspm import wire
from afspm.basics import ControlLost, Publication, RequestError
from afspm.basics.errors import ExperimentEnded, MeasurementFailed, NoResponse, Refused, WireError
from afspm.basics.formatting import day_and_time
from afspm.client.command_retry import NOT_IN_CONTROL, CommandRetry
from afspm.client.control_hold import ControlHold
from afspm.client.cycle import Cycle, CycleOutcome
from afspm.client.experiment_link import ExperimentLink
from afspm.client.keyed_results import KeyedResults, MeasurementResult, check_key
from afspm.client.measurement_setup import MeasurementSetup
from afspm.client.targets import Target, target_from
from afspm.model import (
    ActByHand,
    ControlRequest,
    ControlResponse,
    MeasurementConditions,
    Packet,
    PanelAct,
    Response,
    Scan,
    ScopeState,
    Spectrum,
)
from afspm.model.sessions import KEYED
from afspm.transport.port import CUT_OFF_SHOWS_WITHIN_S
from afspm.wire.messages import ACT_BY_HAND, CONDITIONS

BEGUN_WITHIN_S = 2 * CUT_OFF_SHOWS_WITHIN_S
"""Limit in real time from the accepted action to the published start. The connection may break in between; until a
break is certain to be detected, a new request might measure twice."""
FREE_WITHOUT_RESULT_S = CUT_OFF_SHOWS_WITHIN_S
"""Real time for the results of a microscope that is free. They are published before the state FREE, for which the
translator waits up to its `result_timeout_s` for them; but a packet that was lost comes after it, or never."""
STOPPED_WITHIN_S = 10.0  # after an interrupt by the user
IDLE_AFTER_S = 5.0  # the same, if no start was seen
MOST_FAILURES = 5  # unexplained ones in a row, before a person has to look


class _Watch:
    """A subscription that passes published packets to a `Cycle` until closed."""

    def __init__(self, link: ExperimentLink, target: Target, cycle: Cycle) -> None:
        self._link = link
        self._message = target.message
        self._since_ns = -1 if link.view.newest_ns is None else link.view.newest_ns
        self._conditions: MeasurementConditions | None = None
        self.cycle = cycle
        self.close = link.listen(self._take)

    def is_over(self) -> bool:
        return self.cycle.outcome is not None

    def wait_if_begun(self, until_s: float | None) -> None:
        if self.cycle.begun:
            self.wait_over(until_s)

    def wait_over(self, until_s: float | None) -> bool:
        # late from the moment of publication: a drift correction may register the result before it is passed on
        with self._link.clock.late(Publication.RESULTS):
            while self._link.wait(lambda: self.is_over() or self._is_free, until_s) and not self.is_over():
                if self._stays_free(until_s):
                    self._ask_for_result(until_s)
                elif until_s is not None and self._link.clock.monotonic_s() >= until_s:
                    break
        return self.is_over()

    @property
    def _is_free(self) -> bool:
        return self.cycle.begun and self._link.view.state is ScopeState.FREE

    def _stays_free(self, until_s: float | None) -> bool:
        end_s = self._link.clock.monotonic_s() + FREE_WITHOUT_RESULT_S
        is_in_time = until_s is None or end_s < until_s
        goes_on = self._link.wait(lambda: self.is_over() or not self._is_free, end_s if is_in_time else until_s)
        return is_in_time and not goes_on

    def _ask_for_result(self, until_s: float | None) -> None:
        link = self._link
        text = "the microscope has been free for %g s, and its %s has not arrived: asking for the newest packets"
        link.log.warning(text, FREE_WITHOUT_RESULT_S, self._message)
        link.port.request_since(self._since_ns)
        if self._stays_free(until_s):
            self.cycle.on_state(ScopeState.FREE, link.view.newest_ns)  # without a result by now it is lost

    def _take(self, packet: Packet, ours: bool) -> None:
        if not ours:
            return
        try:
            name = wire.message_of(packet.envelope)
            if name == "ScopeStateMsg":
                self.cycle.on_state(self._link.view.state, packet.time_ns)
            elif name == CONDITIONS.name:  # just before its result
                self._conditions = conditions = wire.decode(name, packet.payload)
                self.cycle.on_conditions(conditions, packet.time_ns)
            elif name == self._message:
                found = self._link.view.described(wire.decode(name, packet.payload))
                self.cycle.on_result(found, packet.time_ns, is_ours=self._is_ours(found))
        except WireError as error:
            self._link.log.warning("a %s can't be read: %s", packet.envelope, error)

    def _is_ours(self, found: Scan | Spectrum) -> bool:
        # a person may scan the same frame; a translator that does not say who asked is believed
        stated = self._conditions
        if stated is None or stated.began_ns is None or stated.time_ns != found.time_ns:
            return True
        return stated.holder == self._link.name


@dataclass
class _MeasurementTask:
    """The progress of a measurement."""

    target: Target
    key: str | None
    stem: str
    until_s: float | None
    repeat: bool = True
    attempt: int = 0
    failures: int = 0
    interruptions: list[str] = field(default_factory=list)
    watch: _Watch | None = None
    acts_seen: int = 0

    @property
    def request_id(self) -> str:
        """Return the id of the starting action: different for each attempt, the same after a restart."""
        return f"{self.stem}/{self.attempt}"

    def drop_watch(self) -> None:
        if self.watch is not None:
            self.watch.close()
        self.watch = None


class MeasurementRunner:
    """A runner of measurements over one link, one at a time."""

    def __init__(
        self,
        link: ExperimentLink,
        control: ControlHold,
        commands: CommandRetry,
        setup: MeasurementSetup,
        results: KeyedResults,
    ) -> None:
        self._link = link
        self._control = control
        self._commands = commands
        self._setup = setup
        self._results = results
        self._channels: dict[str, frozenset[str]] = {}
        self._unfinished = self._of_earlier_life()

    def take(self, target: Target, key: str | None, until_s: float | None, *, repeat: bool = True) -> MeasurementResult:
        """Measure until the result is complete; with a key, only once, even over restarts of the component.

        Raises:
            Refused: the microscope or a limit refuses.
            NoResponse: there is no result by `until_s`.
            MeasurementFailed: five attempts in a row failed for no known reason (`MOST_FAILURES`).
            ControlLost: control was not given by `until_s`; or, without `repeat`, was lost during the measurement.
            InvalidValue: the key is not valid, or was used for another measurement.
        """
        if key is not None and (found := self._results.find(check_key(key), target.facts())) is not None:
            return found
        self._link.wait_caught_up(until_s)  # a cached result must not be taken for this measurement's
        stem = f"{self._link.name}/{KEYED}/{key}" if key else self._link.next_id()
        task = _MeasurementTask(target, key, stem, until_s, repeat)
        try:
            self._take_up(task)
            things, conditions = self._finish(task)
        except BaseException:  # also Ctrl-C and StopRequested: the measurement goes on at the microscope
            if task.key is not None and task.watch is not None and not task.watch.is_over():
                self._unfinished, task.watch = task.watch, None  # the next call with this key takes it up
            raise
        finally:
            task.drop_watch()
        result = MeasurementResult(things, task.interruptions, conditions)
        self._channels[target.what] = frozenset(map(target.name_of, things))
        if key is not None:
            with self._link.clock.late():
                self._results.fulfil(key, target.facts(), result)
        return result

    def _of_earlier_life(self) -> _Watch | None:
        # an earlier life may have left a measurement running: watch for its result from the first packet on
        intent = self._results.pending
        if intent is None:
            return None
        target = target_from(intent["plan"])
        since_ns = -1 if intent["since_ns"] is None else intent["since_ns"]
        return _Watch(self._link, target, Cycle(target.busy, target.fits, since_ns=since_ns, resumed=True))

    def _take_up(self, task: _MeasurementTask) -> None:
        intent, watch = self._results.pending, self._unfinished
        if task.key is None and watch is not None:
            # results from now on belong to the new measurement; earlier ones are kept for the call with their key
            watch.wait_if_begun(task.until_s)
            watch.close()
            self._unfinished = watch if watch.is_over() else None
            return
        self._unfinished = None
        if intent is None or intent["key"] != task.key or intent["plan"] != task.target.facts():
            if watch is not None:
                watch.close()
            return
        task.attempt = intent["attempt"]  # ids of earlier attempts are answered from the cache, not executed
        task.interruptions = intent["interruptions"]
        task.watch = watch
        if watch is not None:
            self._link.log.info("%s %s: resumed", task.target.what, task.key)

    def _finish(self, task: _MeasurementTask) -> tuple[list[Any], MeasurementConditions | None]:
        # the newest result of each name: a restarted translator may have published one twice
        if task.watch is not None:
            task.watch.wait_if_begun(task.until_s)
        if task.watch is not None and task.watch.cycle.outcome is CycleOutcome.COMPLETED:
            self._control.release_inherited()
            cycle = task.watch.cycle
        else:
            with self._control.hold(until_s=task.until_s):
                cycle = self._measure(task)
        return list({task.target.name_of(thing): thing for thing in cycle.results}.values()), cycle.conditions

    def _measure(self, task: _MeasurementTask) -> Cycle:
        watch = task.watch
        if watch is not None and watch.is_over() and watch.cycle.outcome is not CycleOutcome.COMPLETED:
            task.drop_watch()
        elif watch is not None and watch.is_over() and self._is_done(task, watch.cycle):
            return watch.cycle  # a measurement of an earlier life ended during the wait for control
        while True:
            if task.watch is not None and task.watch.is_over():
                task.drop_watch()
            try:
                self._attempt(task)
            except KeyboardInterrupt:
                self._stop(task)
                raise
            if task.watch is not None and task.watch.is_over() and self._is_done(task, task.watch.cycle):
                return task.watch.cycle

    def _attempt(self, task: _MeasurementTask) -> None:
        # A request of an earlier life, or one whose answer was lost with control, is repeated with its id, so that it
        # is not executed twice. Leaves no watch if nothing was begun.
        link, target, until_s = self._link, task.target, task.until_s
        self._control.regain(until_s)
        is_new = task.watch is None
        if task.watch is not None and task.watch.is_over():
            return  # the measurement had begun, and ended during the wait for control
        reached = self._setup.reach(target, until_s)  # takes hours, in which the clock goes on
        if not self._control.held:
            return  # lost on the way: the targets are set again
        if is_new:
            task.attempt = task.attempt + 1 if task.key is None else self._results.next_attempt(task.attempt)
            self._write_down(task)
        # a wait for a limit keeps control here: others would undo the settings made so far
        with link.clock.late(), self._control.kept():
            self._setup.prepare(target, task.key or "", until_s, reached)
        states, task.acts_seen = link.view.count("ScopeStateMsg"), link.view.count(ACT_BY_HAND.name)
        watch = task.watch = task.watch or _Watch(
            link, target, Cycle(target.busy, target.fits, since_ns=link.view.newest_ns)
        )
        cycle = watch.cycle
        with link.clock.late():
            response = self._commands.send(
                ControlRequest.ACTION,
                target.action,
                request_id=task.request_id,
                until_s=until_s,
                is_seen=lambda: cycle.begun,
                is_lost=lambda: link.view.state is ScopeState.FREE,
            )
        if response.ok or cycle.begun:
            self._commands.states = False
            self._follow(task, watch)
            return
        if response.code == ControlResponse.NO_RESPONSE and self._control.held:
            # a translator that died in the command never knows the outcome under this id: the next attempt has another
            cycle.outcome = CycleOutcome.VANISHED
            return
        if _may_have_begun(response, is_new=is_new):
            cycle.control_was_lost()
        else:
            task.drop_watch()
        self._get_over(response, states, until_s, is_new=is_new)

    def _stop(self, task: _MeasurementTask) -> None:
        # after Ctrl-C: stop a measurement that has, or may have, begun, and log the outcome
        target, watch, link = task.target, task.watch, self._link
        if watch is None or watch.is_over():
            return
        link.log.warning("interrupted; stopping the %s", target.what)
        with link.interrupts.deferred(), suppress(RequestError, ExperimentEnded):
            if self._is_stopped(target, watch, link.until(STOPPED_WITHIN_S)):
                link.log.warning("the %s was stopped", target.what)
                return
        if not link.ended:
            link.log.warning("the %s goes on; stop it with scope.action(%r)", target.what, target.stop)

    def _is_stopped(self, target: Target, watch: _Watch, until_s: float | None) -> bool:
        if not self._control.held:
            return False
        response = self._commands.send(ControlRequest.ACTION, target.stop, until_s=until_s)
        if not response.ok:
            return False
        # an action without an answer may not have begun at all
        may_be_idle = not self._link.wait(lambda: watch.cycle.begun, self._link.earlier(IDLE_AFTER_S, until_s))
        return may_be_idle or self._link.wait(watch.is_over, until_s)

    def _get_over(self, response: Response, states: int, until_s: float | None, *, is_new: bool) -> None:
        try:
            self._commands.get_over(ControlRequest.ACTION, response, states, until_s)
        except Refused:
            # A repeated id is answered from the cache: it was refused then, and nothing was done. The next attempt,
            # with a new id, gets the present answer.
            if is_new:
                raise

    def _write_down(self, task: _MeasurementTask) -> None:
        if task.key is not None:
            self._results.intend(
                {
                    "key": task.key,
                    "plan": task.target.facts(),
                    "attempt": task.attempt,
                    "since_ns": self._link.view.newest_ns,
                    "interruptions": task.interruptions,
                }
            )

    def _follow(self, task: _MeasurementTask, watch: _Watch) -> None:
        link, cycle = self._link, watch.cycle
        with link.clock.late():
            begun = link.wait_connected(lambda: cycle.begun or watch.is_over(), BEGUN_WITHIN_S, task.until_s)
        if not begun:
            cycle.outcome = CycleOutcome.VANISHED
        elif not watch.wait_over(task.until_s):
            raise NoResponse(
                f"the {task.target.what} was not finished in time",
                where=link.name,
                hint=f"it goes on; stop it with scope.action({task.target.stop!r}) if it should not",
            )

    def _is_done(self, task: _MeasurementTask, cycle: Cycle) -> bool:
        # an incomplete result is noted as an interruption, before the next attempt
        target = task.target
        missing = self._channels.get(target.what, frozenset()) - frozenset(map(target.name_of, cycle.results))
        blank = [one.channel for one in cycle.results if isinstance(one, Scan) and one.is_blank]
        is_blank = bool(blank) and len(blank) == len(cycle.results)
        if cycle.outcome is CycleOutcome.COMPLETED and not missing and not is_blank:
            if blank:
                self._link.log.warning("%s without any value in %s: NaN alone", target.what, ", ".join(sorted(blank)))
            return True
        if cycle.outcome is CycleOutcome.COMPLETED and is_blank:
            why = "no channel has any value, all are NaN"
        elif cycle.outcome is CycleOutcome.COMPLETED:
            del self._channels[target.what]  # if they are missing again, the microscope no longer records them
            why = f"without {', '.join(sorted(missing))}, which it had before"
        else:
            why = self._why_failed(task, cycle)
        task.interruptions.append(f"{day_and_time(self._link.clock.now_ns(), UTC)}: {why}")
        if not task.repeat and not self._control.held:
            raise ControlLost(f"{target.what} interrupted: {why}", where=self._link.name)
        self._link.log.warning("%s interrupted: %s; retrying", target.what, why)
        # lost control and a person's stop are known reasons; any other failure must not repeat for a night
        task.failures = task.failures + 1 if self._control.held and not self._stopped_by_hand(task) else 0
        if task.failures >= MOST_FAILURES:
            raise MeasurementFailed(f"the {target.what} failed {task.failures} times: {why}", where=self._link.name)
        return False

    def _stopped_by_hand(self, task: _MeasurementTask) -> ActByHand | None:
        view = self._link.view
        act = view.by_hand
        is_new = view.count(ACT_BY_HAND.name) != task.acts_seen
        return act if is_new and act is not None and act.act is PanelAct.STOP else None

    def _why_failed(self, task: _MeasurementTask, cycle: Cycle) -> str:
        target, by_hand = task.target, self._stopped_by_hand(task)
        if by_hand is not None:
            return str(by_hand)
        if not self._control.held:
            return f"control was lost: {self._control.why_lost}"
        if cycle.outcome is not CycleOutcome.ANOTHER and self._results.disk_is_full:
            return "it has no result, and the disk of the run is full"
        if cycle.outcome is CycleOutcome.INTERRUPTED:
            return "it was stopped at the microscope, or its file is missing; the log of the translator says which"
        if cycle.outcome is CycleOutcome.ANOTHER:
            other = target.describe(cycle.other)
            return f"another measurement was taken instead: {other}; does another program use the microscope?"
        return "the microscope is free again without a result; was it restarted?"


def _may_have_begun(response: Response, *, is_new: bool) -> bool:
    # control was lost before the microscope had answered, now or in an earlier life
    return response.code == ControlResponse.NO_RESPONSE or (not is_new and response.code in NOT_IN_CONTROL)
