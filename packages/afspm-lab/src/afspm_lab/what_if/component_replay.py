"""Replay of the recorded lives of one component: its code runs in this process, without waiting."""

from __future__ import annotations

import itertools
import json
import logging
import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from afspm.basics import NS_PER_S, AfspmError, ConfigError, ExperimentClock, Launch
from afspm.model import ProblemNames
from afspm.record import EXPERIMENT_FILE
from afspm.record.run_json import RUN_FILE
from afspm.storage.disk import SYNCER
from afspm.storage.memory import SYNCED_WITHIN_S
from afspm.transport import ProcessActivity, ProcessContext
from afspm.transport.process.context import ExperimentProcess
from afspm.transport.process.loading import load as load_class
from afspm.wire.message_types import register_all as register_messages
from afspm_lab.what_if.alignment import Difference, Output, aligned, first_difference
from afspm_lab.what_if.hazards import HazardGuard
from afspm_lab.what_if.outputs import OutputReader
from afspm_lab.what_if.port_replay import Life, LifeOver, PacketOf, Poll, ReplayPort, recorded_outputs

Make = Callable[[Launch], ExperimentProcess]
"""A function that creates the component of a launch line."""


@dataclass
class ComponentReplay:
    """The result of a replay of one component.

    Attributes:
        name: name of the component.
        recorded, now: recorded and replayed outputs.
        same: number of equal outputs.
        differences: all differences, in order of time.
        first: the first difference; None if all outputs are equal.
        acts: whether the component commands the microscope, or requests control.
        hazards: dependencies beyond the recorded inputs, as text.
        forbidden: description of an action of the component that the replay prevented; empty if there was none.
        stopped: reason why the replay ended before the record; empty for a complete replay.
        real_s: real time of the replay.
        recorded_s: experiment time that the record covers.
        shifted_s: largest difference of time between equal outputs before the first difference.
        unheard: prefixes of envelopes that the class listens to, but that were not subscribed to in the record.
        until_ns: time of the end of the log, if the last life has no recorded end; None otherwise.
    """

    name: str
    recorded: list[Output]
    now: list[Output]
    hazards: list[str] = field(default_factory=list)
    forbidden: str = ""
    stopped: str = ""
    real_s: float = 0.0
    recorded_s: float = 0.0
    until_ns: int | None = None
    unheard: tuple[str, ...] = ()
    same: int = 0
    differences: list[Difference] = field(default_factory=list)
    first: Difference | None = None
    shifted_s: float = 0.0

    def __post_init__(self) -> None:
        self.first = first_difference(self.name, self.recorded, self.now)
        equal = itertools.takewhile(
            lambda pair: pair[0].is_as == pair[1].is_as, zip(self.recorded, self.now, strict=False)
        )
        self.shifted_s = max((abs(one.time_ns - other.time_ns) / NS_PER_S for one, other in equal), default=0.0)
        if self.first is None:
            self.same = len(self.recorded)
        else:
            self.same, self.differences = aligned(self.name, self.recorded, self.now)

    @property
    def acts(self) -> bool:
        flags = ("ADD_EXP_PRBLM", "RMV_EXP_PRBLM")
        return any(one.reaches and one.message not in flags for one in (*self.recorded, *self.now))


def replay(
    lives: Sequence[Life],
    packet_of: PacketOf,
    run_dir: Path,
    *,
    make: Make = load_class,
    settings: Mapping[str, object] | None = None,
    watch: bool = False,
) -> ComponentReplay:
    """Replay all lives of a component, and compare the outputs with the recorded outputs.

    Args:
        packet_of: returns a recorded packet with its values.
        run_dir: folder of the run.
        make: creates the component; by default from the class in the launch line.
        settings: settings that replace all settings of the launch line; None: the recorded settings.
        watch: also detect uses of clocks and random numbers, at half the speed.

    Raises:
        ConfigError: the component can't be created.
        FileError: the record lacks a packet.
    """
    result: list[ComponentReplay] = []
    errors: list[BaseException] = []

    def work() -> None:
        try:
            result.append(_replay(lives, packet_of, run_dir, make, settings, watch=watch))
        except BaseException as error:  # of any kind: it is raised again in the thread of the caller
            errors.append(error)

    # not the main thread: there every wait of a component would install handlers of signals
    thread = threading.Thread(target=work, name="what-if", daemon=True)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return result[0]


def _replay(
    lives: Sequence[Life],
    packet_of: PacketOf,
    run_dir: Path,
    make: Make,
    settings: Mapping[str, object] | None,
    *,
    watch: bool,
) -> ComponentReplay:
    name = lives[0].facts["launch"]["name"]
    recorded, now, stopped = list[Output](), list[Output](), ""
    began_s = time.perf_counter()
    with TemporaryDirectory(prefix="afspm-what-if-") as folder:
        home = _Home(Path(folder), run_dir, name)
        memories = _Memories()
        guard = HazardGuard(Path(folder), (run_dir,), home.memory, memories.saved)
        for number, life in enumerate(lives, 1):
            launch = _launch(life, home.folder, settings)
            outputs = OutputReader(ProblemNames(launch.problems), number)
            is_own = first_difference(name, recorded, now) is not None
            recorded += recorded_outputs(life, outputs)
            home.begin(life, is_own=is_own, remembers=number > 1 and not memories.may_be(life.facts["memory"]))
            with guard.active(), guard.watching() if watch else nullcontext():
                port = ReplayPort(life, outputs, packet_of)
                memories.begin(home.memory, port)
                component = _run(launch, port, life, make)
            with suppress(OSError):  # Windows removes no open file: let the syncer close the memory of this life
                SYNCER.now(SYNCED_WITHIN_S)
            now += port.outputs
            if port.unanswered or port.clock.stuck:
                stopped = port.clock.stuck or f"the record has no answer to: {port.unanswered}"
                break
    until_ns = _until_ns(lives[-1])
    return ComponentReplay(
        name, recorded, now, list(guard.seen), guard.forbidden, stopped, time.perf_counter() - began_s,
        max(0.0, (until_ns - lives[0].facts["now_ns"]) / NS_PER_S),
        until_ns if lives[-1].end is None else None,
        _unheard(launch, component),
    )  # fmt: skip


def _unheard(launch: Launch, component: object) -> tuple[str, ...]:
    if launch.envelopes is None:
        return ()
    listens = getattr(component, "listens", None) or ("",)
    return tuple(prefix for prefix in listens if not prefix.startswith(tuple(launch.envelopes)))


def _until_ns(life: Life) -> int:
    return next((line.now_ns for line in reversed(life.lines) if isinstance(line, Poll)), life.facts["now_ns"])


def _launch(life: Life, folder: Path, settings: Mapping[str, object] | None) -> Launch:
    launch = Launch.from_json(json.dumps(life.facts["launch"]))
    return replace(
        launch,
        settings=launch.settings if settings is None else dict(settings),
        run_dir=str(folder),
        state_dir=str(folder / "state"),
        keeps_requests=False,
    )


def _run(launch: Launch, port: ReplayPort, life: Life, make: Make) -> ExperimentProcess:
    log = logging.getLogger(f"afspm.what_if.{launch.name}")
    log.propagate, log.disabled = False, True
    register_messages(launch.messages)
    component = _made(launch, make)
    port.handled = lambda: getattr(component, "packet", None)
    context = ProcessContext(
        launch,
        port.clock,
        open_port=lambda heard=None: port,
        log=log,
        activity=ProcessActivity(ExperimentClock.real()),  # its readings were not recorded, either
        session=life.facts["session"],
    )
    ended: int | str | None
    try:
        ended = int(component.run_process(context))
    except LifeOver:
        ended = None
    except Exception as error:  # the component's code may raise anything; the record has the type only
        ended = type(error).__name__
    if port.missing is not None:
        raise port.missing
    if ended is not None and (life.end is not None or not port.is_over):
        port.ended(ended)
    return component


def _made(launch: Launch, make: Make) -> ExperimentProcess:
    try:
        return make(launch)
    except AfspmError:
        raise
    except Exception as error:  # the component's code may raise anything, also because the replay forbids it something
        raise ConfigError(f"can't be created: {type(error).__name__}: {error}", where=launch.name) from error


class _Memories:
    """The memories that a life may leave, if it is killed after its last recorded line."""

    def __init__(self) -> None:
        self._texts: list[str] = []
        self._port: ReplayPort | None = None

    def begin(self, file: Path, port: ReplayPort) -> None:
        self._texts = [file.read_text(encoding="utf-8") if file.is_file() else ""]
        self._port = port

    def saved(self, text: str) -> None:
        if self._port is not None and not self._port.is_over:
            self._texts.clear()  # a recorded line follows, so the process lived longer than this save
        self._texts.append(text)

    def may_be(self, memory: str | None) -> bool:
        """Return whether a recorded memory is among them; if not, it shows a decision that no output has shown yet."""
        try:
            return json.loads(memory or "{}") in [json.loads(text or "{}") for text in self._texts]
        except ValueError:  # the recorded file was damaged
            return True


class _Home:
    """Folders of a replayed component, with its saved files as far as they were recorded."""

    def __init__(self, folder: Path, run_dir: Path, name: str) -> None:
        self.folder = folder / "run"
        self._state = self.folder / "state"
        self._state.mkdir(parents=True)
        self._name = name
        self.memory = self._state / f"{name}.json"
        self._results = run_dir / "state" / f"{name}.results"
        for file in (EXPERIMENT_FILE, RUN_FILE):
            if (run_dir / file).is_file():
                shutil.copy(run_dir / file, self.folder)

    def begin(self, life: Life, *, is_own: bool, remembers: bool) -> None:
        """Restore the files saved at the start of a life.

        Args:
            is_own: keep all files of the replay; restore none.
            remembers: keep the memory of the replay; restore the other files.
        """
        if is_own:
            return
        kept = {self._state / f"{self._name}.scope.json": life.facts["measurements"]}
        if not remembers:
            kept[self.memory] = life.facts["memory"]
        for path, text in kept.items():
            if text is None:
                path.unlink(missing_ok=True)
            else:
                path.write_text(text, encoding="utf-8")
        there = self._state / f"{self._name}.results"
        wanted = set(life.facts["results"])
        for path in there.glob("*"):
            if path.name not in wanted:
                path.unlink()
        for missing in wanted - {path.name for path in there.glob("*")}:
            if (self._results / missing).is_file():
                there.mkdir(exist_ok=True)
                shutil.copy(self._results / missing, there)
