"""`Bench`: a component under test, with all other parts of an experiment, in one process."""

from __future__ import annotations

import copy
import logging
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from afspm import wire
from afspm.basics.errors import ConfigError
from afspm.basics.exit_codes import ExitCode
from afspm.basics.launch import Launch
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.basics.units import si
from afspm.client.component import Component
from afspm.client.loop import ComponentLoop
from afspm.experiment.class_loader import ComponentDeclaration
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    ControlState,
    Packet,
    ProblemNames,
    Request,
    Response,
    Scan,
    ScanSet,
)
from afspm.model.snapshot import to_plain
from afspm.scheduler.events import Effect, Input, Publish
from afspm.scheduler.safety.limits import ExperimentLimits
from afspm.scheduler.scheduler import Scheduler
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.step_log import RecordedCore, StepLog
from afspm.scheduler.wire_codec import WireCodec
from afspm.simulation.simulator import Simulator
from afspm.testing.components.bench_cast import BenchCast, cast_of
from afspm.testing.components.hosted_processes import ComponentProcess, TranslatorProcess
from afspm.testing.components.memory_network import ControlLine, Weather
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_process import Process
from afspm.testing.components.simulated_time import SimulatedTime
from afspm.transport.port import Port
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

    Attributes:
        packets: all packets that the scheduler published, oldest first.
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
        self._set_up(cast, folder, seed, dies_in_call)

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
    ) -> Bench:
        """Return a bench with the components, the scheduler and the simulated microscope of an experiment file.

        The recorder is left out: `scans` holds the scans.

        Args:
            overlays: experiment files that override the first.
            component: name of the component under test; by default the only component with a plan of its own.
            without: names of components to leave out, such as web pages and programs in other languages.
            folder, seed, dies_in_call: as for a bench of one component.

        Raises:
            ConfigError: the file has errors, or a part of it can't run on the bench.
        """
        bench = cls.__new__(cls)
        bench._set_up(cast_of(file, *overlays, component=component, without=without), folder, seed, dies_in_call)
        return bench

    def _set_up(self, cast: BenchCast, folder: Path | None, seed: int, dies_in_call: float) -> None:
        self._temporary = TemporaryDirectory(prefix="afspm-bench-") if folder is None else None
        self.folder = Path(self._temporary.name) if self._temporary else Path(folder or "")
        self.name = cast.name
        if taken := {"translator", "scheduler", "person"} & cast.components.keys():
            raise ConfigError(f"a component has the name {min(taken)!r}, which the bench uses", hint="rename it")
        self.packets: list[Packet] = []
        self._lives = {name: _Life() for name in cast.components}
        self._problems = ProblemNames(cast.scheduler_launch.problems)
        self._time = time = SimulatedTime(seed)
        weather = Weather()
        self._scheduler = SchedulerHost(
            time, weather, cast.scheduler.settings(self._context(cast)), WireCodec(),
            lambda one: wire.header(one.envelope, one.payload), self, make_core=lambda: self._core(cast),
        )  # fmt: skip
        self._scheduler.journal.writes_ahead = True
        self._microscope = _SimulatedMicroscope(cast.simulator, cast.microscope)
        self._translator = _BenchTranslator(time, self._microscope.switched_on, self.folder)
        self._scheduler.translator = (self._translator, self._translator)
        self._components = {
            name: self._process(name, one, cast.launches[name], dies_in_call if name == self.name else 0.0)
            for name, one in cast.components.items()
        }
        publishing = [self._components[name] for name, one in cast.components.items() if one.publishes]
        for hosted in self._components.values():
            hosted.publishers = [one for one in publishing if one is not hosted]
        self._person = _Person(time, weather, self._scheduler)
        self._processes: dict[str, Process] = {
            "translator": self._translator,
            "scheduler": self._scheduler,
            "person": self._person,
            **self._components,
        }
        self._running = False
        for process in self._processes.values():
            process.exited = lambda code, process=process: self._exited(process, code)  # type: ignore[misc]
            process.start()

    def _context(self, cast: BenchCast) -> ProcessContext:
        launch = replace(cast.scheduler_launch, state_dir=str(self.folder), run_dir=str(self.folder))
        log, activity = logging.getLogger("afspm.scheduler"), ProcessActivity(self._time)
        return ProcessContext(launch, self._time, open_port=_no_port, log=log, activity=activity)

    def _core(self, cast: BenchCast) -> SchedulerCore:
        context = self._context(cast)
        coordinates = cast.scheduler.coordinates(context, in_process=True)
        if hasattr(self, "_scheduler"):  # else the host makes a core before its first life
            self._scheduler.worker = coordinates.worker
        parts = (cast.scheduler.settings(context), WireCodec(), coordinates.frame)
        if not context.launch.keeps_requests:
            return SchedulerCore(*parts)
        return RecordedCore(*parts, keep=StepLog.of_run(context.launch, context.log).keep)

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
        self._time.at(max(_seconds(when), self.now_s), do, args)

    def _go_to(self, until_s: float) -> None:
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

    # --- for the processes ---

    def stepped(self, host: SchedulerHost, event: Input | None, effects: Sequence[Effect]) -> None:
        """Observe a step of the scheduler; see `StepObserver`."""

    def carried_out(self, host: SchedulerHost, effect: Effect) -> None:
        """Keep each packet that the scheduler publishes."""
        if isinstance(effect, Publish):
            self.packets.append(effect.packet)

    def _exited(self, process: Process, code: int) -> None:
        if code in (ExitCode.DONE, ExitCode.ENDED) or process.banned:
            return
        if isinstance(process, (ComponentProcess, TranslatorProcess)) and isinstance(process.ended_with, Exception):
            return  # `run` raises it
        self._time.after(_RESTART_S, process.start)


class _Life:
    """The lives of one component: `component` is the newest, and errors are raised instead of becoming exit codes."""

    component: Component | None = None

    def run(self, context: ProcessContext) -> int:
        assert self.component is not None
        return _RaisingLoop(self.component, Component, context).run()


class _RaisingLoop(ComponentLoop):
    def _fail(self, error: Exception, state_dir: Path) -> ExitCode:
        raise error


class _SimulatedMicroscope:
    """The simulated microscope over all lives of its translator, each with a new simulator."""

    def __init__(self, simulator: type[Simulator], settings: PlainMapping) -> None:
        self._class = type(f"Bench{simulator.__name__}", (_DrawsInItsThread, simulator), {})
        self._settings = copy.deepcopy(dict(settings))

    def switched_on(self) -> Simulator:
        made: Simulator = self._class(**copy.deepcopy(self._settings))
        self._simulator = made
        return made

    def change_tip(self, condition: str, now_s: float) -> None:
        self._simulator.change_tip(condition)
        # a translator that is killed before it saves has the change in its next life, too
        changes = dict(self._settings.get("tip_changes") or {})
        changes["schedule"] = [*changes.get("schedule", ()), [now_s, condition]]
        self._settings["tip_changes"] = changes


class _DrawsInItsThread:
    def run_drawing(self, work: Callable[[], None]) -> None:
        work()  # in the thread of the bench: the same seed gives the same run


def _no_port(heard: tuple[str, ...] | None = None) -> Port:
    raise AssertionError("the scheduler of a bench has no port")


class _BenchTranslator(TranslatorProcess):
    """A translator that refuses requests on demand. Pending refusals survive a kill."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.refusals: dict[str, tuple[int, str]] = {}

    def peer_asked(self, line: ControlLine, request: Request, number: int) -> None:
        subject = getattr(request.subject, "name", request.subject)
        left, reason = self.refusals.get(subject, (0, "")) if isinstance(subject, str) else (0, "")
        if left and request.kind != ControlRequest.ACTION_SUPPORT:
            self.refusals[subject] = (left - 1, reason)
            line.answer(Response(int(ControlResponse.FAILURE), b"", reason, request.id), number)
        else:
            super().peer_asked(line, request, number)


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
