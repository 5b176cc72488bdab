"""Taking one scan or spectrum, whatever gets in between, exactly once."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC
from typing import Any

from afspm import wire
from afspm.client.command_retry import NOT_IN_CONTROL, CommandRetry
from afspm.client.control_hold import ControlHold
from afspm.client.cycle import Cycle, CycleOutcome
from afspm.client.keyed_results import KeyedResults, MeasurementResult, check_key
from afspm.client.link import ExperimentLink
from afspm.errors import MeasurementFailed, NoResponse, Refused, WireError
from afspm.formatting import day_and_time
from afspm.logic.sessions import KEYED
from afspm.model import ControlRequest, ControlResponse, Packet, Response, ScopeState

BEGUN_WITHIN_S = 5.0  # from the success of the action to the state that says so
MOST_FAILURES = 5  # in a row, that nothing explains: then a person should look


@dataclass(frozen=True)
class MeasurementPlan:
    """What is to be measured.

    Attributes:
        what: for a person: "scan", "spectrum".
        action: what begins it.
        busy: the state of the microscope while it runs.
        message: what its results are published as.
        prepare: sets what it needs, if it isn't set; called in control before each attempt, with when to give up.
        fits: whether a result can be of this plan.
        facts: the plan in JSON's types, to recognise it in a later life.
        name_of: what must not be there twice in one result (the channel of a scan).
        words_for: a result for a person: of what, and where.
    """

    what: str
    action: str
    busy: ScopeState
    message: str
    prepare: Callable[[float | None], None]
    fits: Callable[[Any], bool]
    facts: dict[str, Any]
    name_of: Callable[[Any], str]
    words_for: Callable[[Any], str]


@dataclass
class _Progress:
    """How far a measurement has come."""

    plan: MeasurementPlan
    key: str | None
    stem: str
    until_s: float | None
    attempt: int = 0
    failures: int = 0
    interruptions: list[str] = field(default_factory=list)

    def request_id(self) -> str:
        """Of the action that begins it: another in every attempt, the same in every life."""
        return f"{self.stem}/{self.attempt}"


class MeasurementRunner:
    """Takes measurements over one link, one at a time."""

    def __init__(self, link: ExperimentLink, holding: ControlHold, asker: CommandRetry, results: KeyedResults) -> None:
        self._link = link
        self._holding = holding
        self._asker = asker
        self._results = results
        self._channels: dict[str, frozenset[str]] = {}
        self._resumed: Cycle | None = None
        self._forget_resumed: Callable[[], None] = lambda: None

    def resume(self, busy: dict[str, tuple[ScopeState, str]], fits: Callable[[dict[str, Any], Any], bool]) -> None:
        """Look out, from the first packet on, for what an earlier life asked for and did not get.

        Args:
            busy: by what is measured, the state while it runs and the message of its results.
            fits: whether a result can be of a plan of these facts.
        """
        intent = self._results.pending
        if intent is None or intent["plan"]["what"] not in busy:
            return
        facts = intent["plan"]
        state, message = busy[facts["what"]]
        since_ns = -1 if intent["since_ns"] is None else intent["since_ns"]
        self._resumed = Cycle(state, lambda result: fits(facts, result), since_ns=since_ns, resumed=True)
        self._forget_resumed = self._link.listen(self._listener(self._resumed, message))

    def take(self, plan: MeasurementPlan, key: str | None, until_s: float | None) -> MeasurementResult:
        """Measure until there is a complete result; with a key, once in all lives of the component.

        Raises:
            Refused: the microscope, or a limit, says no.
            NoResponse: not until `until_s`.
            MeasurementFailed: the microscope fails again and again.
            ControlLost: control was not given until `until_s`.
        """
        if key is not None and (found := self._results.find(check_key(key), plan.facts)) is not None:
            return found
        self._link.wait_caught_up(until_s)  # what is cached must not be taken for ours
        progress = _Progress(plan, key, f"{self._link.name}/{KEYED}/{key}" if key else self._link.next_id(), until_s)
        cycle = self._taken_up(progress)
        if cycle is not None and self._is_complete(progress, cycle):
            self._holding.release_inherited()
        else:
            with ExitStack() as control:
                with self._link.clock.late():
                    control.enter_context(self._holding.hold(until_s=until_s))
                cycle = self._measure(progress, cycle)
        result = MeasurementResult(_newest_of_each(plan, cycle.results), progress.interruptions)
        self._channels[plan.what] = frozenset(map(plan.name_of, result.things))
        if key is not None:
            with self._link.clock.late():
                self._results.fulfil(key, plan.facts, result)
        return result

    def _taken_up(self, progress: _Progress) -> Cycle | None:
        """What an earlier life, or an earlier call, was at, if it was this."""
        intent, cycle = self._results.pending, self._resumed
        if progress.key is None and cycle is not None:
            self._keep_resumed(cycle, progress.until_s)
            return None
        self._resumed = None
        if intent is None or intent["key"] != progress.key or intent["plan"] != progress.plan.facts:
            self._forget_resumed()
            return None
        progress.attempt = intent["attempt"]  # ids of attempts before are answered, not executed
        progress.interruptions = intent["interruptions"]
        if cycle is not None:
            self._link.log.info("%s %s: taken up where it was", progress.plan.what, progress.key)
        return cycle

    def _keep_resumed(self, cycle: Cycle, until_s: float | None) -> None:
        """What comes now is not of it; what has come is kept for who asks by its key."""
        if cycle.begun and cycle.outcome is None:
            self._link.wait(lambda: cycle.outcome is not None, until_s)
        self._forget_resumed()
        self._resumed = cycle if cycle.outcome is not None else None

    def _is_complete(self, progress: _Progress, cycle: Cycle) -> bool:
        """Whether what was begun in an earlier life is, or gets, complete without asking again."""
        if cycle.begun and cycle.outcome is None:
            self._link.wait(lambda: cycle.outcome is not None, progress.until_s)
        if cycle.outcome is not None:
            self._forget_resumed()
        return cycle.outcome is CycleOutcome.COMPLETED

    def _measure(self, progress: _Progress, cycle: Cycle | None) -> Cycle:
        """Attempt after attempt, until one is complete."""
        if cycle is not None and cycle.outcome is CycleOutcome.COMPLETED and self._is_done(progress, cycle):
            self._forget_resumed()  # what was begun in an earlier life ended while control was waited for
            return cycle
        again = cycle is not None and cycle.outcome is None
        while True:
            if not again:
                self._forget_resumed()
                progress.attempt += 1
                cycle = None
            cycle = self._attempt(progress, cycle)
            again = cycle is not None and cycle.outcome is None
            if cycle is not None and not again and self._is_done(progress, cycle):
                return cycle

    def _attempt(self, progress: _Progress, resumed: Cycle | None) -> Cycle | None:
        """Prepare and begin once, follow to the end; None if it could not be begun and is to be tried again.

        What was asked for in an earlier life is asked for with the same id: it is not executed twice. So is what comes
        back without an outcome, since control was lost before the microscope had answered.
        """
        link, plan = self._link, progress.plan
        self._holding.regain(progress.until_s)
        if resumed is not None and resumed.outcome is not None:  # it had begun, and ended while control was waited for
            self._forget_resumed()
            return resumed
        if resumed is None:
            self._write_down(progress)
        with link.clock.late():
            plan.prepare(progress.until_s)
        states = link.view.count("ScopeStateMsg")
        cycle = resumed or Cycle(plan.busy, plan.fits, since_ns=link.view.newest_ns)
        forget = self._forget_resumed if resumed else link.listen(self._listener(cycle, plan.message))
        is_unknown = True  # until we know what became of it, an error in between leaves it to be taken up
        try:
            with link.clock.late():
                response = self._asker.send(
                    ControlRequest.ACTION,
                    plan.action,
                    request_id=progress.request_id(),
                    until_s=progress.until_s,
                    is_seen=lambda: cycle.begun,
                )
            if not response.ok and not cycle.begun:
                is_unknown = False
                self._get_over(response, states, progress, is_new=resumed is None)
                if not _may_have_begun(response, resumed):
                    return None
                cycle.control_was_lost()
                self._forget_resumed, forget = forget, _nothing  # listened for until it is asked for again
                return cycle
            self._follow(progress, cycle)
            is_unknown = False
            return cycle
        finally:
            if is_unknown and progress.key is not None:
                self._resumed, self._forget_resumed = cycle, forget
            else:
                forget()

    def _get_over(self, response: Response, states: int, progress: _Progress, *, is_new: bool) -> None:
        """Wait for what stands in the way of an action, or raise Refused."""
        try:
            self._asker.get_over(ControlRequest.ACTION, response, states, progress.until_s)
        except Refused:
            # What was asked for before is answered from memory: it was refused then, and nothing was done. What is
            # answered now, another id tells.
            if is_new:
                raise

    def _write_down(self, progress: _Progress) -> None:
        if progress.key is None:
            return
        self._results.intend(
            {
                "key": progress.key,
                "plan": progress.plan.facts,
                "attempt": progress.attempt,
                "since_ns": self._link.view.newest_ns,
                "interruptions": progress.interruptions,
            }
        )

    def _follow(self, progress: _Progress, cycle: Cycle) -> None:
        """From the success of the action to the end of it."""
        link, until_s = self._link, progress.until_s
        with link.clock.late():
            begun = link.wait_connected(lambda: cycle.begun or cycle.outcome is not None, BEGUN_WITHIN_S, until_s)
        if not begun:
            cycle.outcome = CycleOutcome.VANISHED
        elif not link.wait(lambda: cycle.outcome is not None, until_s):
            raise NoResponse(
                f"the {progress.plan.what} was not finished in time",
                where=link.name,
                hint="it goes on; stop it with scope.action('stop-scan') if it should not",
            )

    def _is_done(self, progress: _Progress, cycle: Cycle) -> bool:
        """Whether the result is complete; else says why not, before the next attempt."""
        plan = progress.plan
        missing = self._channels.get(plan.what, frozenset()) - frozenset(map(plan.name_of, cycle.results))
        if cycle.outcome is CycleOutcome.COMPLETED and not missing:
            return True
        if cycle.outcome is CycleOutcome.COMPLETED:
            del self._channels[plan.what]  # the same again: then these channels are not recorded any more
            why = f"without {', '.join(sorted(missing))}, which it had before"
        elif not self._holding.held:
            why = f"control was lost: {self._holding.why_lost}"
        elif cycle.outcome is CycleOutcome.INTERRUPTED:
            why = "it was stopped, not by us"
        elif cycle.outcome is CycleOutcome.ANOTHER:
            why = (
                f"not what was asked for was measured, but {plan.words_for(cycle.other)}; who else sets the microscope?"
            )
        else:
            why = "the microscope is free again without a result; was it started anew?"
        self._note(progress, why)
        # losing control explains itself and is waited for; all else must not go on for a night
        progress.failures = progress.failures + 1 if self._holding.held else 0
        if progress.failures >= MOST_FAILURES:
            raise MeasurementFailed(f"the {plan.what} failed {progress.failures} times: {why}", where=self._link.name)
        return False

    def _note(self, progress: _Progress, why: str) -> None:
        progress.interruptions.append(f"{day_and_time(self._link.clock.now_ns(), UTC)}: {why}")
        self._link.log.warning("%s interrupted: %s; it will be taken again", progress.plan.what, why)

    def _listener(self, cycle: Cycle, message: str) -> Callable[[Packet, bool], None]:
        view = self._link.view

        def on_packet(packet: Packet, ours: bool) -> None:
            if not ours:
                return
            try:
                name = wire.message_of(packet.envelope)
                if name == "ScopeStateMsg":
                    cycle.on_state(view.state, packet.time_ns)
                elif name == message:
                    cycle.on_result(wire.decode(name, packet.payload), packet.time_ns)
            except WireError as error:
                self._link.log.warning("a %s that can't be read: %s", packet.envelope, error)

        return on_packet


def _may_have_begun(response: Response, resumed: Cycle | None) -> bool:
    """Whether control was lost before the microscope had answered, now or in the life before."""
    unanswered = response.code == ControlResponse.NO_RESPONSE
    return unanswered or (resumed is not None and response.code in NOT_IN_CONTROL)


def _nothing() -> None:
    """Something else forgets it."""


def _newest_of_each(plan: MeasurementPlan, things: list[Any]) -> list[Any]:
    """One result of each name: a translator that was started anew may have published one twice."""
    return list({plan.name_of(thing): thing for thing in things}.values())
