"""`Translator`: the process between the scheduler and one microscope, the same for every microscope.

One loop waits for requests and for the next poll of the controller. Four parts around the driver do the work:
`Connection`, `Observer`, `RequestHandler` and `SafeExit`.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from afspm import wire
from afspm.basics.errors import WireError
from afspm.basics.exit_codes import ExitCode
from afspm.model import ControlResponse, Response, ScopeState, ScopeStatus
from afspm.model.fencing import SchedulerFence
from afspm.storage.memory import Memory
from afspm.translator.connection import Connection
from afspm.translator.controller_lock import ControllerTaken, commanding
from afspm.translator.driver_base import DriverBase
from afspm.translator.emulated_controller import EmulatedController, wired_to
from afspm.translator.hurry import hurried_by
from afspm.translator.observer import Observer
from afspm.translator.requests import RequestHandler, is_withdrawal
from afspm.translator.safe_exit import SafeExit
from afspm.translator.state import TranslatorState
from afspm.translator.temporary_settings import TemporarySettings
from afspm.translator.trace import FILE, TRACE, TraceHeader
from afspm.transport.port import ParentGone, RequestReceived, ServerPort, SubscriberJoined

if TYPE_CHECKING:
    from afspm.transport.process.context import ProcessContext


@dataclass(frozen=True)
class TranslatorRun:
    """The run that a translator belongs to.

    Attributes:
        folder: the run folder.
        name: the identity of the run: only its scheduler is obeyed; empty: the first scheduler that sends a request.
        simulated: True if the microscope is simulated, so that the scheduler of a simulated experiment may use it.
        retracts: True to retract the tip when a request has switched the feedback off and no process is left to switch
            it on again.
        feedback_off: see `Launch`.
    """

    folder: Path
    name: str = ""
    simulated: bool = False
    retracts: bool = False
    feedback_off: str = ""


class Translator:
    """The process that answers requests to a microscope and publishes its states, settings and results.

    Args:
        driver: constructed with its settings, not yet connected.
        port: access to the network.
        memory: values on disk, which survive a restart.
        step: entered around everything that takes time, so that a busy process is not taken for a frozen process.
        controller: the emulator of this run, the only controller to connect to; None: the driver knows the
            address of its controller.
        take: see `Connection`.
    """

    def __init__(
        self,
        driver: DriverBase,
        port: ServerPort,
        memory: Memory,
        run: TranslatorRun,
        log: logging.Logger,
        step: Callable[[], AbstractContextManager[None]] = nullcontext,
        controller: EmulatedController | None = None,
        take: Callable[[str], None] = lambda identity: None,
    ) -> None:
        self.driver = driver
        self._port = port
        self._log = log
        self._step = step
        self._clock = clock = port.clock
        driver.clock, driver.log, driver.run_dir, driver.wake = clock, log, run.folder, self._wake
        self._woken = threading.Event()
        driver.memory = memory.setdefault("microscope", {})
        self.state = state = TranslatorState(memory, clock, 2 * driver.patience_s(driver.common.result_timeout_s / 2))
        temporary = TemporarySettings(driver, state, log)
        self.observer = observer = Observer(driver, port, state, temporary, log)
        if run.feedback_off and state.kept.get("feedback_off_by") != run.feedback_off:  # a restart takes it no more
            state.kept["feedback_off_by"] = run.feedback_off
            observer.panel.may_be_off()
            state.save()
            log.warning("the z feedback is off by intention: so says the person who has begun this run")
        # the sequence keeps its state: the microscope may still be scanning when it is reconnected
        undefined = partial(observer.publish, ScopeStatus(ScopeState.UNDEFINED))
        self._connection = connection = Connection(driver, controller, clock, log, undefined, take)
        self.requests = RequestHandler(
            driver,
            connection,
            observer,
            state,
            temporary,
            log,
            fence=SchedulerFence(run.name, simulated=run.simulated),
            is_connected=port.is_connected,
            reply=self.reply,
        )
        act, observe = self.requests.act, observer.observe
        held = temporary.held
        held.act, held.is_set = act, observer.is_set
        held.switched_on = partial(observer.panel.feedback.is_set, on=True)
        self._safe_exit = SafeExit(
            connection, state, temporary, clock, log, retracts=run.retracts, act=act, observe=observe
        )
        self._ended = self._leaves = False

    def run(self) -> ExitCode:
        """Run until the experiment ends, the parent process ends, or the parent stops this process.

        Returns:
            ENDED after the scheduler's CLOSE; otherwise ORPHAN, after the safe exit.
        """
        try:
            with hurried_by(self._withdraws):
                return self._run()
        finally:
            self.driver.close()
            self._port.close()

    def _run(self) -> ExitCode:
        due, is_due = contextlib.ExitStack(), True
        try:
            while not self._ended:
                if is_due:
                    self._woken.clear()
                    with self._step():
                        self.look()
                with due:  # after the look: on a busy computer the poll may return late
                    due = contextlib.ExitStack()
                    if self._connection.stands:
                        due.enter_context(self.observer.late_at_change())
                arrived = self._port.poll(self.wait_s())
                for one in arrived:
                    if not isinstance(one, ParentGone):
                        with self._step():
                            self.handle(one)
                # after CLOSE there is nothing to do: the scheduler has made the tip safe
                if not self._ended and any(isinstance(one, ParentGone) for one in arrived):
                    self._leaves = True
                    with self._step():
                        self._safe_exit.leave(self._wait_and_look)
                    return ExitCode.ORPHAN
                # a request has looked by itself as far as it needs: another look would delay the next request
                is_due = not arrived or self._woken.is_set() or not self._connection.stands or self.wait_s() <= 0.0
            return ExitCode.ENDED
        finally:
            due.close()

    def _withdraws(self) -> bool:
        # called while an answer of the controller is awaited
        if not (self.driver.withdraws_aside or self.driver.serves_several):
            return False
        if self.requests.withdraws or (self._leaves and self._safe_exit.is_owed()):
            return True
        waiting = self._port.waiting_request()
        try:
            return waiting is not None and is_withdrawal(wire.decode_request(waiting.frames))
        except WireError:
            return False

    def _wake(self) -> None:
        self._woken.set()  # first: the poll that it ends may bring a request, too
        self._port.wake_up()

    def leaves_danger(self) -> bool:
        """Return whether the tip must be retracted before this process ends. Thread-safe."""
        return self._safe_exit.is_owed()

    def handle(self, arrived: RequestReceived | SubscriberJoined) -> None:
        """Handle one message from the network."""
        if not isinstance(arrived, RequestReceived):
            if self._connection.stands:
                self.observer.publish_all()
        elif not self.requests.refuses(arrived):
            if list(arrived.frames) == [wire.CLOSE]:
                self._safe_exit.end()
                self.reply(Response(ControlResponse.SUCCESS))
                self._ended = True
            else:
                self.requests.answer(arrived.frames)

    def look(self) -> None:
        """Poll the controller, and publish the changes since the last poll."""
        self._connection.guarded(self._look)

    def idle_until_s(self) -> float:
        """Return the real time until which `look` does nothing, provided that the controller answers as before."""
        return self.observer.idle_until_s() if self._connection.stands else -math.inf

    def wait_s(self) -> float:
        """Return the real seconds until the next poll or connection attempt."""
        return self.observer.wait_s() if self._connection.stands else self._connection.wait_s()

    def reply(self, response: Response, level: int = logging.INFO) -> None:
        """Answer the current request, and log a refusal."""
        if response.code == ControlResponse.NO_RESPONSE:  # the controller is still starting, which is no refusal
            self._log.log(level, "%s", response.reason)
        elif response.code != ControlResponse.SUCCESS:
            if response.code == ControlResponse.NOT_FREE:  # clients wait, and ask again
                level = logging.DEBUG
            self._log.log(level, "refused, %s: %s", ControlResponse(response.code).name, response.reason)
        self._port.reply(wire.encode_response(response))

    def _look(self) -> None:
        if not self._connection.stands:
            if not self._connection.establish():
                return
            self.observer.begin()
        self.observer.look()

    def _wait_and_look(self, wait_s: float) -> None:
        self._port.poll(wait_s)  # requests that arrive now are not answered
        self.look()


def run_translator(driver: DriverBase, context: ProcessContext, make: Callable[..., Translator] = Translator) -> int:
    """Run a translator, and return its exit code: CRASHED if another run commands the controller.

    Called by the host of processes.
    """
    with contextlib.ExitStack() as stack:
        controller = wired_to(context.launch, driver)
        # a real controller of this address is not touched, so not locked; a shadow commands nothing
        address = "" if controller or driver.only_reads else driver.controller_at
        try:
            take = stack.enter_context(commanding(address, context.launch.run_dir or ""))
            if driver.common.trace:
                _begin_trace(driver, context)
                stack.callback(TRACE.end)
            return _run_locked(driver, context, partial(make, controller=controller, take=take))
        except ControllerTaken as error:
            context.log.error("%s", error)
            # CRASHED, so that the supervisor retries a few times: the other run may be just ending
            return ExitCode.CRASHED


def _begin_trace(driver: DriverBase, context: ProcessContext) -> None:
    from importlib.metadata import version  # imported late: only a trace needs its 40 modules

    # a restarted process gets a file of its own, so that the first trace is not overwritten
    folder = Path(context.launch.run_dir or ".")
    file = next(one for i in itertools.count() if not (one := folder / (f"{i}-{FILE}" if i else FILE)).exists())
    began = datetime.fromtimestamp(context.clock.now_s(), UTC).isoformat(timespec="seconds")
    # a shadow's trace is played back as its driver's: the name finds the way in which the maker's clients begin
    watched = getattr(driver, "watches", type(driver)).__name__
    TRACE.begin(file, TraceHeader(watched, version("afspm"), began), context.clock)


def _run_locked(driver: DriverBase, context: ProcessContext, make: Callable[..., Translator]) -> int:
    from afspm.transport.zmq_server import open_server_port

    launch = context.launch
    # not synced: it is saved several times for each request, and only a kill matters, since after a power cut no
    # request is waiting any more
    memory = Memory(Path(launch.state_dir) / f"{launch.name}.json" if launch.state_dir else None, synced=False)
    if memory.damage:
        context.log.error("the newest saved state is damaged, the one before it is used: %s", memory.damage)
    port = open_server_port(launch, context.clock)
    context.when_stopping(lambda: port.wake_up(ParentGone()))
    run = TranslatorRun(Path(launch.run_dir or "."), launch.run, launch.simulated, launch.retracts, launch.feedback_off)
    driver.adjustable = frozenset(launch.adjustable)
    translator = make(driver, port, memory, run, context.log, context.activity.step)
    context.tip_in_danger(translator.leaves_danger)
    return translator.run()
