"""`Translator`: the process between the scheduler and one microscope. It is the same for every microscope.

One loop waits for requests and for the moment to look at the controller again; whatever is seen to have changed there
is published, whoever changed it.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from afspm import wire
from afspm.clock import Clock
from afspm.errors import AfspmError, ConfigError, WireError
from afspm.exit_codes import ExitCode
from afspm.logic.fencing import Epoch, SchedulerFence
from afspm.logic.sessions import run_of
from afspm.logic.watchdog import feedback_of
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    Request,
    Response,
    ResponseDetail,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.process.memory import Memory
from afspm.translator import settings
from afspm.translator.controller_lock import ControllerTaken, commanding
from afspm.translator.driver import LOST, MEASURING, ControllerLost, Driver
from afspm.translator.emulated_controller import EmulatedController, wired_to
from afspm.translator.live_lines import LiveLines
from afspm.translator.outbox import Outbox
from afspm.translator.outcomes import RequestOutcomes
from afspm.translator.parameters import Value
from afspm.translator.polling import AdaptivePolling
from afspm.translator.requests import RequestHandler
from afspm.translator.sequence import (
    DiscardResults,
    LogError,
    PublishResults,
    PublishStatus,
    SequenceStep,
    StatusSequence,
)
from afspm.transport.port import ParentGone, RequestReceived, ServerPort, SubscriberJoined

if TYPE_CHECKING:
    from afspm.process.context import ProcessContext

_RECONNECT_S = 1.0
_TIP_S = 8.0
"""So long, real time, it is tried to retract the tip when the run is stopped: a controller may be lost just then, or
refuse. A little less than `process.parent` leaves."""
_STARTS_S = 2.0
"""So long, real time, a controller may take that is started together with its translator (an emulated one): until then
it is looked for every `_SOON_S`, and nothing is wrong."""
_SOON_S = 0.1


class Translator:
    """Answers requests to a microscope and publishes what happens at it.

    Args:
        microscope: already made with its settings, not yet connected.
        port: to the network.
        memory: kept over a restart.
        run_dir: the folder of the run.
        step: entered around everything that takes time, so that busy can be told from frozen.
        retracts: whether it retracts the tip when nobody is there any more to switch on the feedback that a request
            has switched off.
        controller: the emulator of this run, in whose place nobody else is ever talked to; None: the microscope
            knows where its controller is.
        run: the identity of the run, whose scheduler alone is obeyed; empty: that which asks first.
        simulated: whether the microscope is, so that the scheduler of a simulated experiment may ask.
    """

    def __init__(
        self,
        microscope: Driver,
        port: ServerPort,
        memory: Memory,
        run_dir: Path,
        log: logging.Logger,
        step: Callable[[], AbstractContextManager[None]] = nullcontext,
        *,
        retracts: bool = False,
        controller: EmulatedController | None = None,
        run: str = "",
        simulated: bool = False,
    ) -> None:
        self.microscope = microscope
        self._controller = controller
        self._port = port
        self._memory = memory
        self._log = log
        self._step = step
        self._retracts = retracts
        self._clock: Clock = port.clock
        microscope.clock, microscope.log, microscope.run_dir = port.clock, log, run_dir
        microscope.wake = port.wake_up
        microscope.memory = memory.setdefault("microscope", {})
        self._kept: dict[str, Any] = memory.setdefault("translator", {"said": 0, "ledger": {}, "outbox": {}})
        said = ScopeStatus(ScopeState(self._kept["said"]))
        self._sequence = StatusSequence(said, 2 * microscope.patience_s(microscope.result_timeout_s / 2))
        self._ledger = RequestOutcomes(self._kept["ledger"], all_or_nothing=microscope.memory_is_all)
        self._outbox = Outbox(microscope, self._kept["outbox"], self._stamp, log)
        self._service = RequestHandler(microscope, self._sequence, self._about_to_act, self._kept, self._save, log)
        self._temporary = self._service.temporary
        self._values: dict[str, Value] = {}
        self._connected = self._started = self._told_lost = False
        self._pace = AdaptivePolling(microscope.poll_period_s, microscope.eager_poll_s)
        self._live = LiveLines(microscope)
        self._paced = ScopeState.UNDEFINED
        self._retry_at_s = self._all_at_s = 0.0
        self._began_s = self._clock.monotonic_s()
        self._why_lost = self._complaint = ""
        self._last_ns = int(self._kept.get("last_ns", 0))
        self._acting: Request | None = None
        self._allegiance = SchedulerFence(run, simulated=simulated)
        self._commander, self._told_refused = b"", ""
        self._ended = False

    def run(self) -> ExitCode:
        """Until the experiment ends, or the parent has gone or wants us to stop."""
        try:
            while not self._ended:
                with self._step():
                    self.look()
                arrived = self._port.poll(self.wait_s())
                for one in arrived:
                    if not isinstance(one, ParentGone):
                        with self._step():
                            self.handle(one)
                # if the scheduler has said that the experiment is over, it has seen to the tip
                if not self._ended and any(isinstance(one, ParentGone) for one in arrived):
                    with self._step():
                        self._leave()
                    return ExitCode.ORPHAN
            return ExitCode.ENDED
        finally:
            self.microscope.close()
            self._port.close()

    def leaves_danger(self) -> bool:
        """Whether, as it ends, it has to retract the tip first. May be called from another thread."""
        return self._retracts and bool(self._kept.get("feedback_off") or self._kept.get("may_have_switched"))

    def handle(self, arrived: RequestReceived | SubscriberJoined) -> None:
        """One thing that came over the network."""
        if isinstance(arrived, RequestReceived):
            if not self._refuses(arrived):
                self._on_request(arrived.frames)
        elif self._connected:
            self._publish_all()

    def wait_s(self) -> float:
        """Real seconds until the controller should be looked at again."""
        if not self._connected:
            return max(0.0, self._retry_at_s - self._clock.monotonic_s())
        real_now_s, now_s = self._clock.monotonic_s(), self._clock.now_s()
        wait_s = min(self._pace.wait_s(real_now_s), self._all_at_s - real_now_s)
        due = (self.microscope.next_change_s(), self._sequence.deadline_s(), self._live.due_s, self._temporary.until_s)
        for at_s in due:
            if at_s is not None:
                # a change that should have been and was not seen yet is looked for eagerly, and not without a break
                until_s = self._clock.real_s(at_s - now_s)
                wait_s = min(wait_s, until_s if until_s > 0.0 else self.microscope.eager_poll_s)
        return max(0.0, wait_s)

    # --- looking at the controller ---

    def look(self) -> None:
        """See what has changed at the controller and publish it."""
        self._trusting(self._look)

    def _look(self) -> None:
        if not (self._connected or self._connect()):
            return
        self._temporary.end_if_due()
        if self._clock.monotonic_s() >= self._all_at_s:
            self._observe()
        elif (status := self._status()) != self._sequence.said:
            # what ends a measurement changes nothing of what is in force; what else happens, may
            self._observe(values=self._sequence.said.state not in MEASURING, status=status)
        for name, payload in self._live.look(self._clock.now_s()):
            self._port.publish(name, payload, self._stamp(1)[0], keep=False)

    def _status(self) -> ScopeStatus:
        """Return what the microscope is in; while something is in force for a while, it is not asked."""
        return self._temporary.status or self.microscope.status()

    def _trusting(self, do: Callable[[], None]) -> bool:
        """Whether that could be done; if not, the controller is gone, or says what can't be.

        Raises:
            ConfigError: it can't be connected to with these settings, ever.
        """
        try:
            do()
            return True
        except ConfigError as error:
            if not self._started:
                raise
            self._lose(error)
        except (*LOST, AfspmError) as error:
            self._lose(error)
        except Exception as error:  # whatever a controller says, its translator lives on
            self._log.debug("while looking at the controller", exc_info=True)
            self._lose(error)
        return False

    def _connect(self) -> bool:
        if self._clock.monotonic_s() < self._retry_at_s:
            return False
        self._find_controller()
        self._connected = True
        if self._complaint:
            self._complaint = ""
            self._log.info("the controller answers")
        if not self._started:
            self._started = True
            for packet in self._outbox.start():
                self._port.publish(*packet)
            self._save()
        self._temporary.end()  # before a kill, or while the controller was lost, nobody could
        self._take_in(self._read())
        self._publish_all()
        return True

    def _find_controller(self) -> None:
        if self._controller is None:
            self.microscope.connect()
        else:
            self._controller.reach(self.microscope)

    def _lose(self, error: Exception) -> None:
        now_s = self._clock.monotonic_s()
        starts = isinstance(error, LOST) and not self._started and now_s - self._began_s < _STARTS_S
        self._retry_at_s = now_s + (_SOON_S if starts else _RECONNECT_S)
        was_connected, self._connected = self._connected, False
        self._why_lost = str(error) if isinstance(error, AfspmError | OSError) else f"{type(error).__name__}: {error}"
        if not starts and (was_connected or self._why_lost != self._complaint):
            self._complaint = self._why_lost
            self._log.error("the controller can't be reached or trusted, it is tried again: %s", self._complaint)
        if was_connected or not self._told_lost:
            # what it was doing is remembered: it may still be at it when it is found again
            self._told_lost = True
            self._publish(ScopeStatus(ScopeState.UNDEFINED))

    def _observe(self, announce: Sequence[str] = (), *, values: bool = True, status: ScopeStatus | None = None) -> None:
        """Publish what is new.

        Args:
            announce: messages to publish even if nothing in them changed.
            values: whether to look at what is in force, too: that takes a question for each parameter.
            status: as it was just seen: a microscope says once only that something was interrupted. None: it is asked.
        """
        if values:
            self._observe_values(announce)
        # the state first: a result that comes in between then waits for the next look, and is not lost
        status = self._status() if status is None else status
        is_over = self._sequence.said.state in MEASURING and status.state not in MEASURING
        if is_over:
            self._pace.over(self._clock.monotonic_s())
        with self._clock.late() if is_over else nullcontext():
            steps = self._sequence.observe(status, self._outbox.look(), self._clock.now_s())
            if steps:
                self._save()  # before anything is out: who comes back from a kill must not tell an older story
                self._play(steps)

    def _observe_values(self, announce: Sequence[str]) -> None:
        values = self._read()
        before = settings.messages(self._values)
        self._take_in(values)
        for name, thing in settings.messages(values).items():
            if name in announce or before.get(name) != thing:
                self._publish(thing)
        wait_s, next_s = self.microscope.poll_period_s, self.microscope.next_change_s()
        if next_s is not None:
            wait_s = min(wait_s, max(0.0, self._clock.real_s(next_s - self._clock.now_s())))
        self._all_at_s = self._clock.monotonic_s() + wait_s

    def _take_in(self, values: dict[str, Value]) -> None:
        """What is in force now, and whether it was a request that has switched the feedback off.

        One that was begun since the last look, by this process or by one that was killed then.
        """
        self._values = values
        is_on, kept = settings.feedback(values).on, self._kept
        switched_off = is_on is False and bool(kept.get("feedback_was_on") and kept.get("may_have_switched"))
        kept["feedback_off"] = is_on is False and (switched_off or bool(kept.get("feedback_off")))
        kept["feedback_was_on"], kept["may_have_switched"] = is_on, False
        if switched_off:
            self._save()

    def _read(self) -> dict[str, Value]:
        """What is in force; differences below the controller's precision are none."""
        table = self.microscope.table
        values = self.microscope.in_force(settings.watched(table))
        old = self._values
        return {
            name: old[name] if name in old and table[name].same(old[name], value) else value
            for name, value in values.items()
        }

    def _play(self, steps: Sequence[SequenceStep]) -> None:
        for step in steps:
            if isinstance(step, PublishStatus):
                self._publish(step.status)
                self._pace_for(step.status.state)
            elif isinstance(step, PublishResults):
                self._deliver()
            elif isinstance(step, DiscardResults):
                self._outbox.discard()
                self._save()
            elif isinstance(step, LogError):
                self._log.error("%s", step.text)

    def _pace_for(self, state: ScopeState) -> None:
        """Look as often as what it now does asks for."""
        before, self._paced, now_s = self._paced, state, self._clock.monotonic_s()
        if state is ScopeState.SCANNING:
            self._live.begin(self._clock.now_ns())
        else:
            self._live.end()
        if state in MEASURING:
            lasts_s, what = self._scan_s() if state is ScopeState.SCANNING else (None, ())
            self._pace.began((state, *what), now_s, lasts_s)
        elif state in (ScopeState.FREE, ScopeState.UNDEFINED):
            self._pace.ended(now_s, as_expected=state is ScopeState.FREE and before in MEASURING)
        else:
            self._pace.moved(now_s)

    def _scan_s(self) -> tuple[float | None, tuple[Value, ...]]:
        """How long, in real seconds, the scan lasts if no time is lost at its edges, and what that depends on."""
        what = tuple(self._values.get(name, 0.0) for name in settings.EXTENT)
        with contextlib.suppress(*LOST, AfspmError, ArithmeticError):
            if all(what) and names.SCAN_SPEED in self.microscope.table:
                speed_m_s = float(self.microscope.in_force([names.SCAN_SPEED])[names.SCAN_SPEED])
                width_m, rows = float(what[0]), float(what[1])
                return self._clock.real_s(2.0 * width_m * rows / speed_m_s), (*what, speed_m_s)
        return None, what

    def _deliver(self) -> None:
        packets = self._outbox.take()
        self._save()  # a restart then publishes the same again, at the same times, and not anew
        for packet in packets:
            self._port.publish(*packet)

    # --- requests ---

    def _refuses(self, arrived: RequestReceived) -> bool:
        """Answer who is not to be obeyed, and return True; False: it is to be obeyed."""
        before, epoch = self._commander, Epoch.decode(arrived.epoch)
        why = self._allegiance.refusal(epoch, _run_in(arrived.frames), lambda: self._port.is_connected(before))
        if not why:
            self._commander = arrived.connection if epoch is not None else before
            return False
        told, self._told_refused = self._told_refused, why
        self._reply(Response(ControlResponse.FAILURE, reason=why), logging.DEBUG if told == why else logging.WARNING)
        return True

    def _on_request(self, frames: Sequence[bytes]) -> None:
        if list(frames) == [wire.CLOSE]:
            self._end()
            return
        try:
            request = wire.decode_request(frames)
        except WireError as error:
            self._reply(Response(error.response, reason=str(error)), logging.DEBUG)  # a stranger can send millions
            return
        known = self._ledger.outcome(request)
        if known is not None:
            self._reply(known)
            return
        try:
            self._answer(request)
        except LOST as error:
            if self._connected:
                self._lose(error)
            reason = f"the controller can't be reached: {error}"
            detail = ResponseDetail.OUTCOME_UNKNOWN
            if self._acting is not request:
                reason, detail = f"not sent: {reason}", ResponseDetail.NOT_SENT
            self._finish(request, Response(ControlResponse.NO_RESPONSE, b"", reason, request.id, detail))

    def _end(self) -> None:
        """The scheduler says that the experiment is over."""
        with contextlib.suppress(*LOST):
            self._stop_measuring()
            self._temporary.end()
        self._reply(Response(ControlResponse.SUCCESS))
        self._ended = True

    def _leave(self) -> None:
        """Nobody is there any more. What is switched off at the panel is for whoever is at the panel."""
        self._trusting(self._stop_measuring)
        if self._connected:
            self._trusting(self._temporary.end)
        until_s = self._clock.monotonic_s() + _TIP_S
        while self.leaves_danger():
            off = "off" if self._kept.get("feedback_off") else "perhaps off"
            why_not = self._retracted() if off == "off" else f"it is not known: {self._why_lost}"
            if not why_not:
                self._log.warning("the run is stopped with the feedback off: the tip is retracted")
                return
            if self._clock.monotonic_s() >= until_s:
                told = "the run is stopped with the feedback %s, and the tip can't be retracted: %s"
                self._log.critical(told, off, why_not)
                return
            self._port.poll(_RECONNECT_S)  # whoever asks for something now gets no answer
            self.look()

    def _retracted(self) -> str:
        """Why the tip can't be retracted; empty: it is."""
        answered: list[Response] = []
        self._trusting(lambda: answered.append(self._retract()))
        if not answered:
            return self._why_lost
        response = answered[0]
        return "" if response.ok else response.reason or str(response.code)

    def _retract(self) -> Response:
        self._reach()
        response = self._act(names.RETRACT)
        self._save()
        return response

    def _reach(self) -> None:
        """For the way out, which must always be open: a controller that is there will do, whatever else it says."""
        if not self._connected:
            self._find_controller()

    def _stop_measuring(self) -> None:
        """The tip does not go on scanning with nobody there."""
        stop = {ScopeState.SCANNING: names.STOP_SCAN, ScopeState.SPEC: names.STOP_SPEC}.get(self._sequence.said.state)
        if stop is not None and self._connected:
            self._act(stop)
            self._observe()
            self._save()

    def _act(self, action: str) -> Response:
        """Do what nobody has asked for."""
        answer = self._service.answer(Request(ControlRequest.ACTION, action))
        self._play(answer.steps)
        return answer.response

    def _answer(self, request: Request) -> None:
        # whether it is free is decided by what it does now, not at the last look
        if self._connected and not _only_asks(request):
            self._trusting(partial(self._observe, values=False))
        if request.subject == names.RETRACT:
            self._reach()
        elif not self._connected:
            raise ControllerLost(f"it is being looked for: {self._why_lost}")
        answer = self._service.answer(request)
        if request.kind == ControlRequest.ACTION and answer.response.ok and not answer.steps:
            self._trusting(self._observe)  # first, so that the peer knows what its action has set when it is answered
        self._finish(request, answer.response)
        self._play(answer.steps)
        if answer.response.ok and (answer.steps or answer.announce):
            self._trusting(partial(self._observe, answer.announce))

    def _about_to_act(self, request: Request) -> None:
        self.microscope.prove()
        self._acting = request
        is_action = request.kind == ControlRequest.ACTION
        # whether the feedback was switched off is to be known by who comes after a kill
        in_doubt = (is_action or feedback_of(request) is not None) and not self._kept.get("may_have_switched")
        self._kept["may_have_switched"] = True
        self._ledger.begin(request)
        # what a kill leaves half set may be set again; an action may not be done again
        if (in_doubt or (request.id and is_action)) and not self.microscope.memory_is_all:
            self._save()

    def _finish(self, request: Request, response: Response) -> None:
        """Write down what came of a request before anybody hears of it, and answer."""
        if self._acting is request:
            self._acting = None
            if request.subject == names.RETRACT and response.ok:
                self._kept["may_have_switched"] = self._kept["feedback_off"] = False  # a tip that is away needs none
            if response.code == ControlResponse.PARAM_ERROR:
                self._ledger.forget(request)  # nothing was changed
            else:
                self._ledger.finish(request, response)
            self._save()
        self._reply(response)

    def _reply(self, response: Response, level: int = logging.INFO) -> None:
        if response.code != ControlResponse.SUCCESS:
            self._log.log(level, "refused, %s: %s", ControlResponse(response.code).name, response.reason)
        self._port.reply(wire.encode_response(response))

    def _save(self) -> None:
        self._kept["said"] = int(self._sequence.said.state)
        self._kept["seen_ns"] = self._clock.now_ns()  # a run that is resumed goes on after it
        self._memory.save()  # a full disk does not stop the tip from being looked after: the memory says it

    # --- publishing ---

    def _publish_all(self) -> None:
        """Everything in force, for a scheduler that has just come."""
        for thing in settings.messages(self._values).values():
            self._publish(thing)
        said = self._sequence.said
        if said.state is not ScopeState.UNDEFINED:
            self._publish(said)
        if said.state in MEASURING and self._paced not in MEASURING:  # since when is not known: it may end any moment
            self._paced = said.state
            self._pace.began(object(), self._clock.monotonic_s())

    def _publish(self, thing: settings.Published | ScopeStatus) -> None:
        name, payload = wire.encode(thing)
        self._port.publish(name, payload, self._stamp(1)[0])

    def _stamp(self, count: int) -> list[int]:
        """Strictly increasing times for so many packets, ns."""
        first = max(self._clock.now_ns(), self._last_ns + 1)
        self._last_ns = first + count - 1
        self._kept["last_ns"] = self._last_ns
        return list(range(first, first + count))


def _run_in(frames: Sequence[bytes]) -> str:
    """The run of a component, in the id of its request; empty: it says none."""
    request_id = frames[2].decode("utf-8", "replace") if len(frames) > 2 else ""
    return run_of(request_id.partition("/")[0], request_id)


def _only_asks(request: Request) -> bool:
    if request.kind == ControlRequest.PARAM:
        return isinstance(request.subject, Parameter) and request.subject.value is None
    return request.kind == ControlRequest.ACTION_SUPPORT


def run_translator(microscope: Driver, context: ProcessContext, make: Callable[..., Translator] = Translator) -> int:
    """What the host runs. While another run commands the controller, it is said which, and the process ends."""
    with contextlib.ExitStack() as stack:
        controller = wired_to(context.launch, microscope)
        address = "" if controller else microscope.controller_at  # a real controller of this address is left alone
        try:
            stack.enter_context(commanding(address, context.launch.run_dir or ""))
        except ControllerTaken as error:
            context.log.error("%s", error)
            return ExitCode.CRASHED  # to be tried again a few times: that run may be just ending
        return _run_alone(microscope, context, partial(make, controller=controller))


def _run_alone(microscope: Driver, context: ProcessContext, make: Callable[..., Translator]) -> int:
    """The sockets, the memory and the translator itself."""
    from afspm.transport.zmq_server import open_server_port

    launch = context.launch
    # saved several times with each request: all of it is for a kill, after a power cut no request is waiting any more
    memory = Memory(Path(launch.state_dir) / f"{launch.name}.json" if launch.state_dir else None, synced=False)
    if memory.damage:
        context.log.error("what it knew is damaged, the generation before is taken up: %s", memory.damage)
    port = open_server_port(launch, context.clock)
    context.when_stopping(lambda: port.wake_up(ParentGone()))
    run_dir = Path(launch.run_dir or ".")
    step = context.activity.step
    told = {"retracts": launch.retracts, "run": launch.run, "simulated": launch.simulated}
    translator = make(microscope, port, memory, run_dir, context.log, step, **told)
    context.tip_in_danger(translator.leaves_danger)
    return translator.run()
