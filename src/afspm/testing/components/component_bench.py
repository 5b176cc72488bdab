"""`Bench`: a component under test, with all other parts of an experiment, in one process."""

from __future__ import annotations

import copy
import logging
import re
import weakref
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from afspm import wire
from afspm.basics.errors import ConfigError
from afspm.basics.exit_codes import ExitCode
from afspm.basics.launch import Launch
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.basics.units import si
from afspm.client.component import Component
from afspm.client.loop import ComponentLoop
from afspm.emulation import Simulator
from afspm.experiment.class_loader import ComponentDeclaration
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlState,
    Packet,
    ProblemNames,
    Request,
    Response,
    Scan,
    ScanSet,
)
from afspm.model.snapshot import to_plain
from afspm.scheduler import ExperimentLimits, Input, SchedulerCore
from afspm.scheduler.events import Effect, Publish
from afspm.scheduler.scheduler import Scheduler
from afspm.scheduler.step_log import RecordedCore, StepLog
from afspm.scheduler.wire_codec import WireCodec
from afspm.testing.components.bench_cast import BenchCast, cast_of
from afspm.testing.components.bench_microscope import BenchMicroscope, BenchTranslator, Polls, polls_from
from afspm.testing.components.hosted_processes import BlockingProcess, ComponentProcess, TranslatorProcess
from afspm.testing.components.memory_network import ControlLine, Weather
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_process import Process
from afspm.testing.components.simulated_time import SimulatedTime
from afspm.transport import Port
from afspm.transport.process.context import ProcessActivity, ProcessContext

Time = str | float
"""Experiment time: text with a unit ("20 min"), or seconds."""

_RESTART_S = 1.0
_SETTLE_S = 0.5


class Bench:
    """A component under test with the real scheduler decisions, a simulated microscope and a fake clock.

    ::

        bench = Bench(MyComponent(), microscope={"surface": "steps"})
        bench.run(until="2 h")
        assert len(bench.scans) == 4

    If a component ends with an error, `run` raises that error.

    Args:
        component: the component under test. Each life runs a copy.
        others: more components by name, such as a component that takes the scans.
        microscope: settings of the simulated microscope, as in the experiment file.
        problems: names and numbers of your own problems, as in the experiment file.
        limits: limits of the scheduler.
        folder: folder for saved state and scans; None: a temporary folder.
        seed: the same seed gives the same run.
        dies_in_call: the chance that the component is killed at a call to the network.
        keeps_requests: keep inputs and requests in `folder`, as `[record] requests = true` does.
        polls: "all": the translator polls the microscope as often as in an experiment, ten times as slow; by default
            the polls that can find nothing are skipped, and the packets are the same.
    """

    def __init__(
        self,
        component: Component,
        *,
        others: Mapping[str, Component] | None = None,
        microscope: PlainMapping | None = None,
        problems: Mapping[str, int] | None = None,
        limits: ExperimentLimits | None = None,
        folder: Path | None = None,
        seed: int = 1,
        dies_in_call: float = 0.0,
        keeps_requests: bool = False,
        polls: Polls | Literal[""] = "",
    ) -> None:
        name = re.sub(r"(?<!^)(?=[A-Z])", "_", type(component).__name__).lower()
        if name in (others or {}):
            raise ConfigError(f"two components have the name {name!r}", hint="rename the one in `others`")
        named, given = dict(problems or {}), dict(microscope or {})
        components = {name: component, **(others or {})}
        launches = {
            each: Launch(
                each,
                f"{type(one).__module__}.{type(one).__qualname__}",
                envelopes=ComponentDeclaration.of_class(type(one)).listens,
                problems=named,
                keeps_requests=keeps_requests,
            )
            for each, one in components.items()
        }
        cast = BenchCast(
            name, components, launches, Scheduler(limits=to_plain(limits or ExperimentLimits())),
            Launch(
                "scheduler",
                "afspm.scheduler.scheduler.Scheduler",
                {"limits": to_plain(limits or ExperimentLimits())},
                problems=named,
                simulated=True,
                keeps_requests=keeps_requests,
            ),
            Simulator, given,
        )  # fmt: skip
        self._set_up(cast, folder, seed, dies_in_call, polls)

    @classmethod
    def of(
        cls,
        file: str | Path,
        *overlays: str | Path,
        component: str = "",
        without: Collection[str] = (),
        folder: Path | None = None,
        seed: int = 1,
        dies_in_call: float = 0.0,
        polls: Polls | Literal[""] = "",
    ) -> Bench:
        """Return a bench with the components, the scheduler and the simulated microscope of an experiment file.

        The recorder is left out: `scans` holds the scans.

        Args:
            overlays: experiment files that override the first.
            component: name of the component under test; by default the only component with a plan of its own.
            without: names of components to leave out, such as web pages and programs in other languages.
            folder, seed, dies_in_call, polls: as for a bench of one component.

        Raises:
            ConfigError: the file has errors, or a part of it can't run on the bench.
        """
        bench = cls.__new__(cls)
        cast = cast_of(file, *overlays, component=component, without=without)
        bench._set_up(cast, folder, seed, dies_in_call, polls)
        return bench

    def _set_up(self, cast: BenchCast, folder: Path | None, seed: int, dies_in_call: float, polls: str) -> None:
        temporary = TemporaryDirectory(prefix="afspm-bench-", ignore_cleanup_errors=True) if folder is None else None
        self.folder = Path(temporary.name) if temporary else Path(folder or "")
        self.name = cast.name
        if taken := {"translator", "scheduler", "person"} & cast.components.keys():
            raise ConfigError(f"a component has the name {min(taken)!r}, which the bench uses", hint="rename it")
        self._published = _PublishedPackets()
        self._lives = {name: _Life() for name in cast.components}
        self._problems = ProblemNames(cast.scheduler_launch.problems)
        self._time = time = SimulatedTime(seed)
        weather = Weather()
        scheduler = _SchedulerOfCast(cast, time, self.folder)
        self._scheduler = scheduler.hosted(time, weather, self._published)
        self._microscope = BenchMicroscope(cast.simulator, cast.microscope)
        self._translator = BenchTranslator(time, self._microscope, self.folder, polls_from(polls))
        self._scheduler.translator = (self._translator, self._translator)
        self._components = {
            name: self._process(name, one, cast.launches[name], dies_in_call if name == self.name else 0.0)
            for name, one in cast.components.items()
        }
        publishing = [self._components[name] for name, one in cast.components.items() if one.publishes]
        for hosted in self._components.values():
            hosted.published = self._published.all.append
            hosted.publishers = [one for one in publishing if one is not hosted]
        self._person = _Person(time, weather, self._scheduler)
        self._processes: dict[str, Process] = {
            "translator": self._translator,
            "scheduler": self._scheduler,
            "person": self._person,
            **self._components,
        }
        self._running = False
        self._plans = 0
        self._planned: dict[int, tuple[Callable[..., None], tuple[object, ...]]] = {}
        for process in self._processes.values():
            process.exited = partial(_exited, process)
            process.start()
        # The threads hold their processes, and no process holds the bench: so it is collected, and ends the threads.
        self._ending = weakref.finalize(self, _end, [*self._components.values(), self._translator], temporary)
        self._ending.atexit = False

    def _process(self, name: str, component: Component, launch: Launch, dies_in_call: float) -> ComponentProcess:
        life = self._lives[name]

        def make() -> Component:
            life.component = made = copy.deepcopy(component)
            made.run_process = life.run  # type: ignore[method-assign]
            return made

        return ComponentProcess(
            self._time, Weather(), self._scheduler, name, make, self.folder, dies_in_call=dies_in_call, launch=launch
        )

    # --- running ---

    @property
    def now_s(self) -> float:
        """Experiment time since the start, in s."""
        return self._time.monotonic_s()

    def run(self, *, until: Time) -> None:
        """Run until an experiment time since the start.

        Raises:
            ConfigError: the time has passed.
            Exception: the error of a component or of the translator.
        """
        until_s = _seconds(until)
        if until_s < self.now_s:
            raise ConfigError(f"{until} has passed: it is {self.now_s:.0f} s after the start", where="Bench.run")
        self._go_to(until_s)

    def at(self, when: Time, do: Callable[..., None], *args: object) -> None:
        """Call `do(*args)` at an experiment time since the start: `bench.at("20 min", bench.kill)`."""
        # kept here, since `do` often holds the bench, and the threads hold the timeline
        number = self._plans = self._plans + 1
        self._planned[number] = (do, args)
        self._time.at(max(_seconds(when), self.now_s), _do_planned, (weakref.ref(self), number))

    def close(self) -> None:
        """End the threads of the bench, and delete its temporary folder; the results remain.

        Without this call the same happens once the bench is collected as garbage.
        """
        self._ending()

    def _go_to(self, until_s: float) -> None:
        if not self._ending.alive:
            raise ConfigError("the bench was closed", where="Bench.run")
        self._running = True
        try:
            self._time.run_until(until_s)
        finally:
            self._running = False
        for process in (*self._components.values(), self._translator):
            if isinstance(process.ended_with, Exception):
                error, process.ended_with = process.ended_with, None
                raise error

    def _settle(self) -> None:
        if not self._running:
            self._go_to(self.now_s + _SETTLE_S)

    # --- faults ---

    def flag(self, problem: str | int) -> None:
        """Flag a problem, as another component does."""
        self._ask(ControlRequest.ADD_EXP_PRBLM, self._problems.number(problem))

    def clear(self, problem: str | int) -> None:
        """Clear a problem, as its solver does."""
        self._ask(ControlRequest.RMV_EXP_PRBLM, self._problems.number(problem))

    def set_mode(self, mode: ControlMode) -> None:
        """Set the control mode, as a person does; MANUAL takes control from the component."""
        self._ask(ControlRequest.SET_CONTROL_MODE, int(mode))

    def kill(self, name: str = "", *, restarts: bool = True) -> None:
        """Kill the component, or another process by name ("scheduler", "translator").

        The process starts again after a second with its saved state, unless `restarts` is False.
        """
        if (process := self._processes.get(name or self.name)) is None:
            raise ConfigError(f"there is no process {name!r}", hint=f"there are {', '.join(self._processes)}")
        process.banned = not restarts
        process.kill()
        self._settle()

    def lose_connection(self, for_time: Time = 0.0) -> None:
        """Break the connections of the component, and restore them after `for_time`."""
        self._components[self.name].cut(_seconds(for_time))
        self._settle()

    def refuse(self, subject: str, *, times: int = 1, reason: str = "refused by the bench") -> None:
        """Let the microscope refuse the next `times` requests for an action ("start-scan") or a parameter."""
        self._translator.refusals[subject] = (times, reason)

    def change_tip(self, condition: str) -> None:
        """Change the tip now, also during a scan, to "sharp", "blunt", "double" or "contaminated"."""
        if not self.now_s:
            self._settle()  # the microscope is not switched on before the first step
        self._microscope.change_tip(condition, self.now_s)
        self._settle()

    def _ask(self, kind: ControlRequest, subject: object) -> None:
        self._person.ask(Request(kind, subject, wire.encode_request(Request(kind, subject))[-1]))
        self._settle()

    # --- results ---

    @property
    def packets(self) -> list[Packet]:
        """All packets that the scheduler published, among them the translator's, oldest first."""
        return self._published.of_scheduler

    def published(self, message: str) -> list[Any]:
        """Return all published messages of a name, oldest first: `bench.published("ScanLines")`.

        They come from the scheduler, which passes on the translator's, and from all components.
        """
        found = (one for one in self._published.all if wire.message_of(one.envelope) == message)
        return [wire.decode(message, one.payload) for one in found]

    @property
    def scans(self) -> list[ScanSet]:
        """All scans that were published, each with its channels."""
        found: dict[str, list[Scan]] = {}
        for packet in self.packets:
            if packet.envelope.startswith("Scan2d"):
                scan = wire.decode("Scan2d", packet.payload)
                found.setdefault(scan.filename or str(scan.time_ns), []).append(scan)
        return [ScanSet(scans) for scans in found.values()]

    @property
    def component(self) -> Any:
        """The component in its current or last life."""
        return self._lives[self.name].component

    @property
    def components(self) -> Plain:
        """All components by name, in their current or last life."""
        return {name: life.component for name, life in self._lives.items()}

    @property
    def memory(self) -> Plain:
        return dict(self.component.memory)

    @property
    def is_done(self) -> bool:
        """True once the component has returned from `run`, or has ended with the experiment."""
        return self._components[self.name].ended_with in (ExitCode.DONE, ExitCode.ENDED)

    @property
    def control_state(self) -> ControlState:
        """The control mode, the component in control and the problems, as the scheduler publishes them."""
        return self._scheduler.core.control.published()

    @property
    def problems(self) -> tuple[str, ...]:
        """Names of the problems that are flagged."""
        return tuple(map(self._problems.name, self.control_state.problems))


class _PublishedPackets:
    """The packets of a bench: those of the scheduler, and all in their order."""

    def __init__(self) -> None:
        self.of_scheduler: list[Packet] = []
        self.all: list[Packet] = []

    def stepped(self, host: SchedulerHost, event: Input | None, effects: Sequence[Effect]) -> None:
        """Observe a step of the scheduler; see `StepChecker`."""

    def carried_out(self, host: SchedulerHost, effect: Effect) -> None:
        """Keep each packet that the scheduler publishes."""
        if isinstance(effect, Publish):
            self.of_scheduler.append(effect.packet)
            self.all.append(effect.packet)


class _SchedulerOfCast:
    """The scheduler of a cast, with a new core in each life."""

    def __init__(self, cast: BenchCast, time: SimulatedTime, folder: Path) -> None:
        self._scheduler = cast.scheduler
        launch = replace(cast.scheduler_launch, state_dir=str(folder), run_dir=str(folder))
        log, activity = logging.getLogger("afspm.scheduler"), ProcessActivity(time)
        self._context = ProcessContext(launch, time, open_port=_no_port, log=log, activity=activity)
        self._host: SchedulerHost | None = None

    def hosted(self, time: SimulatedTime, weather: Weather, published: _PublishedPackets) -> SchedulerHost:
        self._host = SchedulerHost(
            time, weather, self._scheduler.settings(self._context), WireCodec(),
            wire, published, make_core=self._core,
        )  # fmt: skip
        return self._host

    def _core(self) -> SchedulerCore:
        context = self._context
        coordinates = self._scheduler.coordinates(context, in_process=True)
        if self._host is not None:  # else the host makes a core before its first life
            self._host.worker = coordinates.worker
        parts = (self._scheduler.settings(context), WireCodec(), coordinates.frame)
        if not context.launch.keeps_requests:
            return SchedulerCore(*parts)
        return RecordedCore(*parts, keep=StepLog.of_run(context.launch, context.log).keep)


def _do_planned(bench: weakref.ref[Bench], number: int) -> None:
    if (found := bench()) is not None:
        do, args = found._planned.pop(number)
        do(*args)


def _exited(process: Process, code: int) -> None:
    if code in (ExitCode.DONE, ExitCode.ENDED) or process.banned:
        return
    if isinstance(process, (ComponentProcess, TranslatorProcess)) and isinstance(process.ended_with, Exception):
        return  # `run` raises it
    process.timeline.after(_RESTART_S, process.start)


def _end(processes: Sequence[BlockingProcess], temporary: TemporaryDirectory[str] | None) -> None:
    # called by the garbage collector in any thread, which must not wait
    for process in processes:
        process.abandon()
    if temporary is not None:
        temporary.cleanup()


class _Life:
    """The lives of one component: `component` is the newest, and errors are raised instead of becoming exit codes."""

    component: Component | None = None

    def run(self, context: ProcessContext) -> int:
        assert self.component is not None
        return _RaisingLoop(self.component, Component, context).run()


class _RaisingLoop(ComponentLoop):
    def _fail(self, error: Exception, state_dir: Path) -> ExitCode:
        raise error


def _no_port(heard: tuple[str, ...] | None = None) -> Port:
    raise AssertionError("the scheduler of a bench has no port")


class _Person(Process):
    """A simulated person; each request is sent once, as soon as there is a connection."""

    def __init__(self, time: SimulatedTime, weather: Weather, scheduler: SchedulerHost) -> None:
        super().__init__(time, "person")
        self._weather, self._scheduler = weather, scheduler
        self._unsent: list[Request] = []
        self._asked = 0

    def begin(self) -> None:
        self._line = ControlLine(self.timeline, self._weather, self, self._scheduler, self.name)

    def ask(self, request: Request) -> None:
        self._asked += 1
        request.id = f"person/{self._asked}"
        self._unsent.append(request)
        self.line_up(self._line)

    def line_up(self, line: ControlLine) -> None:
        if self._line.up:
            unsent, self._unsent = self._unsent, []
            for request in unsent:
                self._line.ask(request)

    def line_down(self, line: ControlLine) -> None:
        """Do nothing: the line reconnects by itself."""

    def answered(self, line: ControlLine, number: int, response: Response) -> None:
        """Do nothing: the state that the scheduler publishes shows the effect."""


def _seconds(time: Time) -> float:
    return si(time, "s")
