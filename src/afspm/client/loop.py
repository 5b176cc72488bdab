"""The main loop of a component: one thread, which waits in one place and calls one handler at a time."""

from __future__ import annotations

import contextlib
import json
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from afspm import wire
from afspm.basics import RequestError
from afspm.basics.clock import NS_PER_S, Clock
from afspm.basics.errors import ConfigError, ExperimentEnded, MeasurementFailed
from afspm.basics.exit_codes import ExitCode
from afspm.basics.own_fault import OwnFault
from afspm.client.backlog import PacketBacklog
from afspm.client.dispatch import HostedComponent, MessageDispatcher, overrides
from afspm.client.experiment_link import ExperimentLink
from afspm.client.keyed_results import kept_in
from afspm.client.port_log import RecordedPort, recorded
from afspm.client.scope import Scope
from afspm.model import RELAY_REQUEST, Frame, Packet, Problem, ProcessCondition, ProcessStates, RelayedMessage
from afspm.storage.memory import Memory
from afspm.transport.process import failure
from afspm.transport.process.context import ProcessContext
from afspm.transport.process.failure import write_fault
from afspm.transport.process.parent import StopRequested

AFTER_THE_END_S = 30.0  # to handle packets from before the end
AFTER_A_STOP_S = 0.5  # short: the parent kills a process soon after stopping it
AT_ONCE = 16  # packets handled between two polls of the port: a KILL must not wait for a long backlog


class ComponentLoop:
    """The main loop of one component, until the experiment ends, the process is stopped, or `run` returns.

    Args:
        base: class with the empty handlers that the component overrides.
    """

    def __init__(self, component: HostedComponent, base: type, context: ProcessContext) -> None:
        self._component = component
        self._context = context
        self._activity = context.activity
        self._activity.longest_step_s = component.longest_step_s
        self._is_script = overrides(component, base, "run")
        self._backlog = PacketBacklog()
        self._has_begun = False
        self._has_reacted = False  # a handler has returned after a tenure of control
        launch = context.launch
        self._dispatcher = MessageDispatcher(component, base, launch.envelopes, context.log)
        for handler, message in self._dispatcher.never_called().items():
            text = "%s is never called: the component does not subscribe to %s; add it to `listens` or `envelopes`"
            context.log.warning(text, handler, message)
        port, self._clock = context.open_port(), context.clock
        if launch.keeps_requests:
            port = recorded(port, context, self._dispatcher.wants, lambda: component.packet)
            self._clock = port.clock
        self._ticker = None if self._is_script else _ticker(component, self._clock)
        self._link = ExperimentLink.of_launch(launch, port, context.session, activity=self._activity, log=context.log)
        self._link.listen(self._keep)
        self._state_dir = Path(launch.state_dir) if launch.state_dir else None
        self._give_attributes(self._state_dir)

    def run(self) -> int:
        """Run to the end, and return the exit code."""
        port = self._link.port
        try:
            code = self._run_and_end()
        except Exception as error:  # of any kind: only to write it down, it is raised again
            if isinstance(port, RecordedPort):
                port.end(type(error).__name__)
            raise
        if isinstance(port, RecordedPort):
            port.end(code)
        return code

    def _run_and_end(self) -> int:
        try:
            code = self._run_to_the_end()
            self._end()
        except MeasurementFailed as failed:
            self._stop_all_measurements(failed)
            raise
        except ConfigError:
            raise
        except Exception as error:  # the component's code may raise anything: it decides between a restart and an end
            if self._state_dir is None or self._may_pass(error):
                raise
            code = self._fail(error, self._state_dir)
        finally:
            self._backlog.close()
            self._link.port.close()
            self._component.memory.close()
            self._component.scope._results.close()
        return code

    def _fail(self, error: Exception, state_dir: Path) -> ExitCode:
        name = self._context.name
        failure.log(self._context.log, error, name)
        kept = json.dumps([self._component.memory.saved_text, *kept_in(state_dir, name)])
        write_fault(state_dir, name, OwnFault(type(error).__name__, failure.place_of(error), zlib.crc32(kept.encode())))
        return ExitCode.OWN_FAULT

    def _may_pass(self, error: Exception) -> bool:
        # A handler's error may pass, since the next life gets other messages. Not if control was taken and no handler
        # has returned since: every life would repeat its requests to the microscope.
        is_reaction = not self._is_script and self._has_begun
        return failure.may_pass(error) or (is_reaction and (self._has_reacted or not self._component.scope.tenures))

    def _run_to_the_end(self) -> ExitCode:
        try:
            self._run()
        except ExperimentEnded:
            self._handle_rest(AFTER_THE_END_S)
            return ExitCode.ENDED
        except StopRequested:
            self._handle_rest(AFTER_A_STOP_S)
            return ExitCode.ORPHAN
        return ExitCode.ENDED if self._link.ended else ExitCode.DONE

    def _run(self) -> None:
        with self._handler():
            self._component.on_start()
        if not self._is_script:  # a script may continue the block for which its earlier life held control
            self._component.scope.give_back_inherited()
        self._has_begun = True
        if self._is_script:
            self._await_others(self._context.launch.after)
            with self._activity.step():
                self._component.run()
        else:
            self._serve()

    def _await_others(self, names: tuple[str, ...]) -> None:
        if not names:
            return
        began_ns, ends = self._clock.now_ns(), dict[str, ProcessCondition]()

        def note(packet: Packet, ours: bool) -> None:
            if packet.envelope.partition("_")[0] != ProcessStates.__name__:
                return
            states = wire.decode(ProcessStates.__name__, packet.payload)
            if states.time_ns < began_ns:
                return  # kept since before the run was resumed, with processes that the stop has ended
            for one in states.processes:
                ends.pop(one.name, None)  # a process that is started again is not done
                if one.condition in (ProcessCondition.ENDED, ProcessCondition.GIVEN_UP):
                    ends[one.name] = one.condition

        self._context.log.info("begins when %s is done", " and ".join(names))
        with contextlib.ExitStack() as stack:
            stack.callback(self._link.listen(note))
            stack.enter_context(self._clock.passing())
            self._link.wait(lambda: ends.keys() >= {*names})
        for name in names:
            if ends[name] is ProcessCondition.GIVEN_UP:
                self._context.log.warning("%s was given up; beginning all the same", name)

    def _stop_all_measurements(self, failed: MeasurementFailed) -> None:
        # the flag keeps all components from measuring: a restarted component would repeat the failing scan without end
        self._context.log.critical("%s. Nothing is measured until a person clears device-malfunction", failed.what)
        with contextlib.suppress(RequestError, ExperimentEnded, StopRequested):
            self._component.scope.flag(Problem.DEVICE_MALFUNCTION)

    def _serve(self) -> None:
        while True:
            due_s = self._ticker.due_in_s() if self._ticker else None
            if due_s is not None and due_s <= 0.0 and self._ticker:
                with self._handler():
                    self._component.on_tick()
                self._ticker.done()
                due_s = 0.0
            self._link.pump(0.0 if len(self._backlog) else due_s)
            self._handle_backlog(AT_ONCE)

    def _handle_backlog(self, at_most: float = float("inf")) -> None:
        while at_most > 0 and (packet := self._backlog.take()) is not None:
            with self._handler():
                self._dispatcher.give(packet, self._link.view)
            at_most -= 1

    def _handle_rest(self, within_s: float) -> None:
        # measurements before the end still need their handlers: a table must not lack the last scan
        until_s = self._clock.monotonic_s() + within_s
        while self._has_begun and len(self._backlog) and self._clock.monotonic_s() < until_s:
            with contextlib.suppress(ExperimentEnded, StopRequested):  # handlers can send no more requests
                self._handle_backlog(1)

    def _end(self) -> None:
        # an error in `on_end` must not hide why the process ends
        try:
            with self._handler():
                self._component.on_end()
        except (ExperimentEnded, StopRequested):
            self._context.log.warning("on_end sent a request after the end, and did nothing after it")
        except Exception as error:  # the component's code may raise anything
            self._context.log.error("on_end failed: %s", failure.describe(error, self._context.name))

    @contextlib.contextmanager
    def _handler(self) -> Iterator[None]:
        # memory is saved when a handler has returned, not when it has failed half way
        tenures = self._component.scope.tenures
        with self._activity.step():
            yield
            self._has_reacted |= self._component.scope.tenures != tenures
            if not self._is_script:  # a script itself calls `memory.save` at a consistent moment
                self._component.memory.save_changes()

    def _keep(self, packet: Packet, ours: bool) -> None:
        if self._dispatcher.wants(packet):
            self._backlog.put(packet)

    def _give_attributes(self, state_dir: Path | None) -> None:
        component, context, launch = self._component, self._context, self._context.launch
        has_handlers = self._is_script and self._dispatcher.wants_anything
        between = self._handle_backlog if has_handlers else lambda: None
        frame = Frame.SAMPLE if launch.sample_coordinates else Frame.TIP
        given = {
            "scope": Scope(self._link, context.problems, state_dir, between, frame),
            "clock": self._clock,
            "log": context.log,
            "name": context.name,
            "memory": Memory(state_dir / f"{context.name}.json" if state_dir else None),
            "run_dir": Path(launch.run_dir or "."),
            "simulated": launch.simulated,
            "packet": None,
        }
        for name, value in given.items():
            if hasattr(component, name):
                what = f"{type(component).__name__} has its own {name!r}, which afspm gives to each component"
                raise ConfigError(what, where=context.name, hint=f"give yours another name, such as own_{name}")
            setattr(component, name, value)
        component._publish = self._publish

    def _publish(self, message: object, envelope: str | None) -> None:
        name, payload = wire.encode(message)
        if wire.is_relayed(name):
            if envelope is not None:
                what = f"{name} is relayed, and has the envelope {name}_{self._context.name}, not {envelope!r}"
                raise ConfigError(what, where=self._context.name, hint="publish it without an envelope")
            request_id = self._link.next_id()
            try:
                self._component.scope.announce(message, request_id)
            except ExperimentEnded:  # the last scan is handled after the end, and its results are recorded
                # with its id, since the end may have come after the request was sent
                self._link.send_only(RELAY_REQUEST, RelayedMessage(name, payload), request_id)
            return
        if envelope is not None and wire.message_of(envelope) != name:
            raise ConfigError(
                f"the envelope {envelope!r} does not begin with the message's name {name!r}",
                where=self._context.name,
                hint=f"e.g. {name}_{envelope}",
            )
        self._link.port.publish(envelope or name, payload)


class _Ticker:
    """The schedule of ticks, at multiples of the period from the start."""

    def __init__(self, period: int, now: Callable[[], int], real_s: Callable[[int], float]) -> None:
        self._period = period
        self._now = now
        self._real_s = real_s
        self._next = now()

    def due_in_s(self) -> float:
        """Return the real seconds until the next tick; 0 if a tick is due."""
        left = self._next - self._now()
        return self._real_s(left) if left > 0 else 0.0

    def done(self) -> None:
        """Schedule the next tick, and skip missed ticks."""
        missed = max(0, self._now() - self._next) // self._period
        self._next += (missed + 1) * self._period


def _ticker(component: HostedComponent, clock: Clock) -> _Ticker | None:
    if component.period_s is None:
        return None
    if not component.period_s > 0.0:
        raise ConfigError(f"a period of {component.period_s} s can't be kept", where=type(component).__name__)
    period = max(1, round(component.period_s * NS_PER_S))
    if component.period_time == "real":
        return _Ticker(period, lambda: round(clock.monotonic_s() * NS_PER_S), lambda ns: ns / NS_PER_S)
    return _Ticker(period, clock.now_ns, lambda ns: clock.real_s(ns / NS_PER_S))
