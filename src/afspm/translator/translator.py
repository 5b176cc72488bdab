"""`Translator`: the process between the scheduler and one microscope, the same for every microscope.

One loop waits for requests and for the moment to look at the controller again. Four parts around the driver do the
work: `Connection`, `Observer`, `RequestHandler` and `SafeExit`.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from afspm import wire
from afspm.basics.exit_codes import ExitCode
from afspm.model import ControlResponse, Response, ScopeState, ScopeStatus
from afspm.model.fencing import SchedulerFence
from afspm.storage.memory import Memory
from afspm.translator.connection import Connection
from afspm.translator.controller_lock import ControllerTaken, commanding
from afspm.translator.driver_base import DriverBase
from afspm.translator.emulated_controller import EmulatedController, wired_to
from afspm.translator.observer import Observer
from afspm.translator.requests import RequestHandler
from afspm.translator.safe_exit import FeedbackWatch, SafeExit
from afspm.translator.state import TranslatorState
from afspm.translator.temporary_settings import TemporarySettings
from afspm.translator.trace import FILE, TRACE, TraceHeader
from afspm.transport.port import ParentGone, RequestReceived, ServerPort, SubscriberJoined

if TYPE_CHECKING:
    from afspm.transport.process.context import ProcessContext


class Translator:
    """Answers requests to a microscope and publishes what happens at it.

    Args:
        driver: already made with its settings, not yet connected.
        port: to the network.
        memory: kept over a restart.
        run_dir: the folder of the run.
        step: entered around everything that takes time, so that busy can be told from frozen.
        retracts: True if it retracts the tip when nobody is left to switch the feedback on again that a request has
            switched off.
        controller: the emulator of this run, in whose place no other controller is ever reached; None: the driver
            knows where its controller is.
        run: the identity of the run, whose scheduler alone is obeyed; empty: that which asks first.
        simulated: True if the microscope is, so that the scheduler of a simulated experiment may ask.
    """

    def __init__(
        self,
        driver: DriverBase,
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
        self.driver = driver
        self._port = port
        self._log = log
        self._step = step
        self._clock = clock = port.clock
        driver.clock, driver.log, driver.run_dir, driver.wake = clock, log, run_dir, port.wake_up
        driver.memory = memory.setdefault("microscope", {})
        self.state = state = TranslatorState(memory, clock, 2 * driver.patience_s(driver.result_timeout_s / 2))
        feedback = FeedbackWatch(state.kept)
        temporary = TemporarySettings(driver, state, log)
        self.observer = observer = Observer(driver, port, state, temporary, feedback, log)
        # what it was doing is remembered: it may still be at it when it is found again
        undefined = partial(observer.publish, ScopeStatus(ScopeState.UNDEFINED))
        self._connection = connection = Connection(driver, controller, clock, log, on_lost=undefined)
        self.requests = RequestHandler(
            driver,
            connection,
            observer,
            state,
            feedback,
            temporary,
            log,
            fence=SchedulerFence(run, simulated=simulated),
            is_connected=port.is_connected,
            reply=self.reply,
        )
        act, observe = self.requests.act, observer.observe
        self._safe_exit = SafeExit(
            connection, state, feedback, temporary, clock, log, retracts=retracts, act=act, observe=observe
        )
        self._ended = False

    def run(self) -> ExitCode:
        """Run until the experiment ends, or the parent has gone or wants it to stop."""
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
                        self._safe_exit.leave(self._wait_and_look)
                    return ExitCode.ORPHAN
            return ExitCode.ENDED
        finally:
            self.driver.close()
            self._port.close()

    def leaves_danger(self) -> bool:
        """Return True if it has to retract the tip before it ends. May be called from another thread."""
        return self._safe_exit.is_owed()

    def handle(self, arrived: RequestReceived | SubscriberJoined) -> None:
        """Handle one thing that came over the network."""
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
        """See what has changed at the controller and publish it."""
        self._connection.guarded(self._look)

    def wait_s(self) -> float:
        """Return the real seconds until the controller should be looked at again."""
        return self.observer.wait_s() if self._connection.stands else self._connection.wait_s()

    def reply(self, response: Response, level: int = logging.INFO) -> None:
        """Answer the request in hand, and log a refusal."""
        if response.code == ControlResponse.NO_RESPONSE:  # it waits for the controller, which refuses nothing
            self._log.log(level, "%s", response.reason)
        elif response.code != ControlResponse.SUCCESS:
            self._log.log(level, "refused, %s: %s", ControlResponse(response.code).name, response.reason)
        self._port.reply(wire.encode_response(response))

    def _look(self) -> None:
        if not self._connection.stands:
            if not self._connection.establish():
                return
            self.observer.begin()
        self.observer.look()

    def _wait_and_look(self, wait_s: float) -> None:
        self._port.poll(wait_s)  # a peer that asks for something now gets no answer
        self.look()


def run_translator(driver: DriverBase, context: ProcessContext, make: Callable[..., Translator] = Translator) -> int:
    """Run a translator as the host does. While another run commands the controller, say which, and end."""
    with contextlib.ExitStack() as stack:
        controller = wired_to(context.launch, driver)
        address = "" if controller else driver.controller_at  # a real controller of this address is left alone
        try:
            stack.enter_context(commanding(address, context.launch.run_dir or ""))
        except ControllerTaken as error:
            context.log.error("%s", error)
            return ExitCode.CRASHED  # to be tried again a few times: that run may be just ending
        if driver.trace:
            _begin_trace(driver, context)
            stack.callback(TRACE.end)
        return _run_alone(driver, context, partial(make, controller=controller))


def _begin_trace(driver: DriverBase, context: ProcessContext) -> None:
    """Keep what is said to the controller; a process that is started again keeps it in a file of its own."""
    folder = Path(context.launch.run_dir or ".")
    file = next(one for i in itertools.count() if not (one := folder / (f"{i}-{FILE}" if i else FILE)).exists())
    began = datetime.fromtimestamp(context.clock.now_s(), UTC).isoformat(timespec="seconds")
    TRACE.begin(file, TraceHeader(type(driver).__name__, version("afspm"), began), context.clock)


def _run_alone(driver: DriverBase, context: ProcessContext, make: Callable[..., Translator]) -> int:
    """Open the sockets and the memory, and run the translator."""
    from afspm.transport.zmq_server import open_server_port

    launch = context.launch
    # saved several times with each request: all of it is for a kill, after a power cut no request is waiting any more
    memory = Memory(Path(launch.state_dir) / f"{launch.name}.json" if launch.state_dir else None, synced=False)
    if memory.damage:
        context.log.error("the newest saved state is damaged, the one before it is used: %s", memory.damage)
    port = open_server_port(launch, context.clock)
    context.when_stopping(lambda: port.wake_up(ParentGone()))
    run_dir = Path(launch.run_dir or ".")
    step = context.activity.step
    driver.adjustable = frozenset(launch.adjustable)
    told = {"retracts": launch.retracts, "run": launch.run, "simulated": launch.simulated}
    translator = make(driver, port, memory, run_dir, context.log, step, **told)
    context.tip_in_danger(translator.leaves_danger)
    return translator.run()
