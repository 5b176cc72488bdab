"""`Emulator`: a vendor's controller that controls the simulated instrument, inside an experiment or standalone."""

from __future__ import annotations

import errno
import importlib
import logging
import math
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, ClassVar

from afspm.basics import entry_points
from afspm.basics.addresses import Listens
from afspm.basics.clock import Clock, ExperimentClock
from afspm.basics.errors import AfspmError, ConfigError, ErrorCollector, TransportError
from afspm.basics.exit_codes import ExitCode
from afspm.basics.plain_data import PlainMapping
from afspm.basics.requirements import require
from afspm.basics.units import Unit
from afspm.simulation.background import in_background
from afspm.simulation.emulation.controller_clock import ControllerClock
from afspm.simulation.faults import Fault, Faults
from afspm.simulation.instrument import SimulatedInstrument
from afspm.simulation.truth import Truth
from afspm.translator.emulated_controller import AddressNotice, notice_file
from afspm.transport.polling import WakeUp
from afspm.transport.port import Killed
from afspm.transport.zmq_port import open_port

if TYPE_CHECKING:
    from afspm.transport.process.context import ProcessContext

LOOPBACK = "127.0.0.1"
LONGEST_WAIT_S = 60.0
_AGAIN_S = 1.0
"""Delay of the next `tick` after an unexpected error, experiment time."""
_TAKEN = {100, 10013, 10048} if sys.platform == "win32" else {errno.EADDRINUSE}
"""Error numbers of a port in use. On Windows they come from the C library, as ZeroMQ reports them, and from its
sockets: WSAEACCES, if the other program uses the port exclusively, and WSAEADDRINUSE."""
_LOOKS_S = 0.2
"""Interval between checks of a button's file, real time."""
_COMMON_FAULTS = {
    "hang": "the whole program hangs for the duration (real time)",
    "clock-ahead": "the clock of the controller's computer is set ahead by the duration",
    "clock-back": "the clock of the controller's computer is set back by the duration",
}
FAREWELL_S = 0.5
"""Real seconds that a controller stays after the end of the experiment, so that the translator can stop the tip."""


class Crashed(AfspmError):
    """The error that ends the emulated controller without a reply, like a crash."""

    code = "emulator-crashed"


@dataclass(frozen=True)
class ScreenButton:
    """A button on the emulated screen, which a person presses by deleting a file.

    Attributes:
        pressed: called from the emulator's thread.
    """

    file: Path
    pressed: Callable[[], object]


class Emulator(ABC):
    """A vendor's controller, emulated. Write the abstract methods; all are called from one thread::

        class Mine(Emulator):
            vendor = "Mine"
            usual = {"port": 1234}
            fault_kinds = {"no-reply": "a request is not answered"}

            def open(self): ...bind; return f"127.0.0.1:{port}"
            def serve(self, timeout_s): ...wait for a request or `self.woken`, and answer
            def tick(self, now_s): ...end scans, write files; return when there is more to do

    Args:
        port: the port to listen on; 0: any free port.
        seed: seed of all random numbers.
        clock_off_s: lead of the clock of the controller's computer, whose times stand in its files; negative: it is
            behind.
        dates_files: True if that clock also gives the files their modification times, as on a disk of that computer.
        as_reported: what others report of real controllers (`reported`): True for all of it, or a list of names.
        faults: each a text as on the command line (`KIND[@SECONDS][,count=N][,duration=SECONDS]`) or a table of
            `kind`, `at_s`, `count`, `duration_s`.
        withdrawn: True if the tip is withdrawn at the beginning, with the feedback off.
        surface: a kind of sample, or a table of `kind` and its settings.
        tip, tip_changes, drift, feedback, scanner, noise, signals, iv, force, z, property_map: settings of the
            simulated world, as in `World.from_settings`. The scanner may be a name: "stm-4k".

    Attributes:
        clock, log: of the experiment; set before `open`, like all following attributes.
        folder: where the controller saves its files.
        rig: the instrument.
        file_clock: the clock of the controller's computer, whose times stand in its files.
        faults: queried at each point where something can go wrong.
        woken: becomes readable when `serve` must return; include its `fileno` in the wait of `serve`.
        listening: publishes an address; if it changes, call with "" before the old socket is closed, then with the new
            address.
    """

    vendor: ClassVar[str]
    usual: ClassVar[PlainMapping] = {}
    """Settings for the usual address of the vendor's own controller, used by `afspm emulate` on request."""
    fault_kinds: ClassVar[Mapping[str, str]] = {}
    """The faults of the emulator, with the effect of each; with a `MakerProgram` also `**MakerProgram.fault_kinds`.

    `all_faults` adds the faults of every emulator.
    """

    reported: ClassVar[Mapping[str, str]] = {}
    """What others report of real controllers, by name, and the emulator does on request (`as_reported`)."""
    reported_of_others: ClassVar[Mapping[str, str]] = {}
    """What others report of another maker's controllers, only by name."""

    modes: ClassVar[Sequence[str]] = ("amplitude", "current", "frequency-shift")
    """The modes of the simulated feedback that the controller supports."""

    emulated: ClassVar[bool] = True
    """An experiment with an emulator counts as simulated: its clock may run at another speed."""
    listens: ClassVar[tuple[str, ...]] = ()
    """An emulator receives only the end of the experiment."""

    clock: Clock
    log: logging.Logger
    folder: Path
    rig: SimulatedInstrument
    file_clock: ControllerClock
    faults: Faults
    woken: WakeUp[None]
    listening: Callable[[str], None]

    def __init__(
        self,
        *,
        port: Annotated[int, Listens()] = 0,
        seed: int = 1,
        clock_off_s: Annotated[float, Unit("s")] = 0.0,
        dates_files: bool = False,
        as_reported: bool | Sequence[str] = False,
        faults: Sequence[str | PlainMapping | Fault] = (),
        withdrawn: bool = False,
        surface: str | PlainMapping = "steps",
        tip: PlainMapping | None = None,
        tip_changes: PlainMapping | None = None,
        drift: PlainMapping | None = None,
        feedback: PlainMapping | None = None,
        scanner: str | PlainMapping | None = None,
        noise: PlainMapping | None = None,
        signals: PlainMapping | None = None,
        iv: PlainMapping | None = None,
        force: PlainMapping | None = None,
        z: PlainMapping | None = None,
        property_map: PlainMapping | None = None,
    ) -> None:
        self.port = port
        self.seed = seed
        self._clock_off_s, self._dates_files, self._withdrawn = clock_off_s, dates_files, withdrawn
        self.as_reported = self._chosen(as_reported)
        world = {
            "surface": surface,
            "tip": tip,
            "tip_changes": tip_changes,
            "drift": drift,
            "feedback": feedback,
            "scanner": scanner,
            "noise": noise,
            "signals": signals,
            "iv": iv,
            "force": force,
            "z": z,
            "property_map": property_map,
        }
        self._world_settings = {name: settings for name, settings in world.items() if settings is not None}
        self._faults = [Fault.of(fault) for fault in faults]
        self._stop = threading.Event()
        self._leave_at_s = math.inf
        self._button: ScreenButton | None = None

    def _chosen(self, as_reported: bool | Sequence[str]) -> frozenset[str]:
        if isinstance(as_reported, bool):
            return frozenset(self.reported) if as_reported else frozenset()
        known = {**self.reported, **self.reported_of_others}
        if unknown := set(as_reported) - known.keys():
            hint = f"true, or some of {', '.join(known)}" if known else "it knows none"
            raise ConfigError(f"no report is called {min(unknown)!r}", where="as_reported", hint=hint)
        return frozenset(as_reported)

    def check(self) -> None:
        """Check the settings.

        Raises:
            ConfigError: invalid world or faults, or a missing package. FileError: a sample that can't be read.
        """
        from afspm.simulation import World
        from afspm.simulation.settings import one_of

        errors = ErrorCollector()
        with errors:
            require(type(self))
        with errors:
            world = World.from_settings(self._world_settings, self.seed, 0.0)
            one_of(world.settings.feedback.mode, self.modes, "feedback.mode")
        with errors:
            Faults(self._faults, self.all_faults(), 0.0)
        errors.raise_all()

    @classmethod
    def all_faults(cls) -> dict[str, str]:
        """Return every fault with its effect: faults of the class and faults common to all emulators."""
        return {**cls.fault_kinds, **_COMMON_FAULTS}

    # -- what one writes

    @abstractmethod
    def open(self) -> str:
        """Start listening and return the address for clients."""

    @abstractmethod
    def serve(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` real seconds for clients or `woken`, and answer received requests.

        Answer each request separately, and turn its errors into the vendor's own error replies: after an exception that
        reaches the base class, the present activity is dropped and that client gets no answer.

        Raises:
            Crashed: to end without an answer.
        """

    def tick(self, now_s: float) -> float | None:
        """Advance to `now_s` (experiment time): end scans and write files.

        Called before every `serve`, so also right after each request.

        Returns:
            the time of the next event, apart from events of the rig and the faults.
        """
        return None

    @abstractmethod
    def close(self) -> None:
        """Stop listening. Also called if `open` failed."""

    def abandon(self) -> None:
        """Drop the present activity after an error in `tick` or `serve`. Override if other activities can run."""
        self.rig.abandon(self.clock.now_s())

    # -- services for subclasses

    def show_button(self, name: str, why: str, pressed: Callable[[], object]) -> None:
        """Show a button until a person presses it or it is removed. Only one button is shown at a time.

        A person, or a test, presses the button by deleting the file `delete-to-NAME.txt` in `folder`: so any program
        with access to the folder can press it, inside an experiment and standalone. In an experiment the standard input
        belongs to the supervisor, Windows has no signal for it, and a port would be a protocol that no controller has.

        Args:
            why: the reason to press the button, for the log and the file.
        """
        self.take_button_away()
        file = self.folder / f"delete-to-{name}.txt"
        try:
            file.write_text(f"{why}\nDelete this file to press the button.\n", encoding="utf-8")
        except OSError as error:
            self.log.error("the button %s can't be shown, since %s can't be written: %s", name, file, error)
            return
        self._button = ScreenButton(file, pressed)
        self.log.warning("%s: delete %s to press the button", why, file)

    def take_button_away(self) -> None:
        """Remove the button and its file."""
        button, self._button = self._button, None
        if button is not None:
            with suppress(OSError):  # the button is gone: a file that stays has no effect
                button.file.unlink()

    def run(self, clock: Clock, folder: Path, log: logging.Logger, listening: Callable[[str], None]) -> None:
        """Run the controller until `stop`, or until shortly after the end of the experiment.

        Args:
            listening: called with the address whenever it changes; empty while the controller does not listen.

        Raises:
            Crashed: an emulated crash.
            TransportError: another program listens at its port.
        """
        self.clock, self.folder, self.log, self.listening = clock, folder, log, listening
        truth = Truth(folder / "truth.jsonl")
        self.rig = SimulatedInstrument(
            self._world_settings, self.seed, clock.now_s(), run=in_background, note=truth.note
        )
        if self._withdrawn:
            self.rig.engaged, self.rig.setup.feedback = False, replace(self.rig.setup.feedback, on=False)
        truth.note(clock.now_s(), "start", {"settings": self._world_settings, "seed": self.seed})
        self.faults = Faults(self._faults, self.all_faults(), clock.now_s())
        self.file_clock = ControllerClock(self._clock_off_s, dates_files=self._dates_files)
        if self._clock_off_s:
            self.rig.note(clock.now_s(), "clock of the controller", {"off_s": self._clock_off_s})
        folder.mkdir(parents=True, exist_ok=True)
        self.woken = WakeUp()
        self.rig.drawing.wake, self.rig.drawing.log, self.rig.drawing.clock = self.woken.post, log, clock
        due = ExitStack()
        try:
            listening(self._open())
            while not self._stop.is_set() and clock.monotonic_s() < self._leave_at_s:
                wait_s = self._wait_s()
                self.rig.note_changes(clock.now_s())  # of a person at the panel, before the wait
                due.close()  # after the tick: on a busy computer the wait may end late
                self.rig.drawing.release()
                ends_s = self.rig.next_change_s(clock.now_s())
                if ends_s is not None:
                    due.enter_context(clock.late(ends_s))
                self._call_guarded(self.serve, wait_s)
                self.woken.take()
                self.rig.account(clock.now_s())
        finally:
            due.close()
            self.close()
            self.take_button_away()
            self.woken.close()

    def _open(self) -> str:
        try:
            return self.open()
        except Exception as error:  # servers raise OSError or zmq.ZMQError: the error number decides
            if _TAKEN.isdisjoint((getattr(error, "errno", None), getattr(error, "winerror", None))):
                raise
            hint = "end that program or choose another port; without --port and --usual a free port is chosen"
            raise TransportError(
                f"another program listens at port {self.port or 'of the vendor'}", hint=hint
            ) from error

    def stop(self) -> None:
        """Stop `run` soon. Thread-safe, also before `run` starts."""
        self._stop.set()
        self._wake()

    def _wake(self) -> None:
        if hasattr(self, "woken"):  # it exists only while running
            self.woken.post()

    @contextmanager
    def running(self, folder: Path, clock: Clock | None = None) -> Iterator[str]:
        """Run the controller in a thread inside the `with` block, for tests and scripts; yield the address.

        Raises:
            any exception of `run` except an emulated crash, even before the controller listens.
        """
        opened: list[str] = []
        failed: list[BaseException] = []
        settled = threading.Event()

        def listening(address: str) -> None:
            opened.append(address)
            settled.set()

        def work() -> None:
            try:
                self.run(
                    clock or ExperimentClock.real(), folder, logging.getLogger(f"emulated {self.vendor}"), listening
                )
            except Crashed:
                pass
            except BaseException as error:  # raised again by the thread that waits for the start
                failed.append(error)
            finally:
                settled.set()

        thread = threading.Thread(target=work, name=f"emulated {self.vendor}", daemon=True)
        self._stop.clear()
        thread.start()
        settled.wait()
        try:
            if opened:
                yield opened[0]
        finally:
            self.stop()
            thread.join()
        if failed:
            raise failed[0]

    def run_process(self, context: ProcessContext) -> int:
        """Run as a process of an experiment, with its clock and its run folder. Called by the host."""
        context.when_stopping(self.stop)
        threading.Thread(target=self._await_experiment_end, args=(context,), name="experiment", daemon=True).start()

        with ExitStack() as stack:
            launch, notice = context.launch, None
            if launch.state_dir:
                notice = stack.enter_context(
                    closing(AddressNotice(notice_file(launch.state_dir, launch.name), launch.run))
                )
            return self._run_telling(context, notice)

    def _run_telling(self, context: ProcessContext, notice: AddressNotice | None) -> int:
        def listening(address: str) -> None:
            if address:
                context.log.warning("SIMULATED: an emulated %s controller listens at %s", self.vendor, address)
            if notice is not None:
                notice.tell(address)

        try:
            self.run(context.clock, Path(context.launch.run_dir or ".") / context.name, context.log, listening)
        except Crashed as crash:
            context.log.warning("an emulated crash: %s", crash)
            return ExitCode.CRASHED
        return ExitCode.ORPHAN if self._stop.is_set() else ExitCode.ENDED

    def _await_experiment_end(self, context: ProcessContext) -> None:
        # in a thread of its own: `serve` waits for the maker's clients, not for the experiment
        port = open_port(context.launch, context.clock)
        while not any(isinstance(incoming, Killed) for incoming in port.poll(None)):
            pass
        self._leave_at_s = context.clock.monotonic_s() + FAREWELL_S
        self._wake()
        port.close()

    def _call_guarded(self, do: Callable[[float], float | None], argument: float) -> float | None:
        try:
            return do(argument)
        except Crashed:
            raise
        except Exception:  # no request of a client may end the emulator: any error ends its activity only
            self.log.exception("the emulated %s failed and dropped its current activity", self.vendor)
            self.abandon()
            return self.clock.now_s() + _AGAIN_S

    def _wait_s(self) -> float:
        self._look_for_button()
        hang = self.faults.strikes("hang", self.clock.now_s())
        if hang is not None:
            self.log.warning("an emulated fault: %s", hang)
            self._stop.wait(hang.duration_s)
        self._set_clock()
        now_s = self.clock.now_s()
        times = (self._call_guarded(self.tick, now_s), self.rig.next_change_s(now_s), self.faults.next_s(now_s))
        due_s = min((at_s for at_s in times if at_s is not None), default=math.inf)
        leave_in_s = self._leave_at_s - self.clock.monotonic_s()
        longest_s = LONGEST_WAIT_S if self._button is None else _LOOKS_S
        return max(0.0, min(longest_s, leave_in_s, self.clock.real_s(due_s - now_s)))

    def _set_clock(self) -> None:
        now_s = self.clock.now_s()
        for kind, sign in (("clock-ahead", 1.0), ("clock-back", -1.0)):
            jump = self.faults.strikes(kind, now_s)
            if jump is not None:
                self.file_clock.jump(sign * jump.duration_s, now_s)
                self.rig.note(now_s, "clock of the controller", {"off_s": self.file_clock.off_s})

    def _look_for_button(self) -> None:
        button = self._button
        if button is not None and not button.file.exists():
            self._button = None
            self.log.warning("%s was deleted: the button is pressed", button.file.name)

            def press(now_s: float) -> None:
                button.pressed()

            self._call_guarded(press, self.clock.now_s())


def emulator_names() -> list[str]:
    """Return the short names of all installed emulators: "nanonis" for `NanonisEmulator`."""
    return sorted(map(_short_name, entry_points.names(entry_points.EMULATORS)))


def find_emulator(name: str) -> type[Emulator]:
    """Return the emulator with a short name, or a user's own emulator by "module.Class".

    Raises:
        ConfigError: an unknown name, or a module that cannot be imported.
    """
    module_name, _, class_name = name.rpartition(".")
    if module_name:
        found = getattr(_imported(module_name, name), class_name, None)
    else:
        declared = {_short_name(one): one for one in entry_points.names(entry_points.EMULATORS)}
        if name not in declared:
            raise ConfigError(f"there is no emulator {name!r}", hint=f"there are {', '.join(declared) or 'none'}")
        found = entry_points.load(entry_points.EMULATORS, declared[name])
    if not (isinstance(found, type) and issubclass(found, Emulator)):
        raise ConfigError(
            f"{name} is not an emulator", hint="a class derived from afspm.simulation.emulation.emulator.Emulator"
        )
    return found


def _short_name(class_name: str) -> str:
    return class_name.removesuffix("Emulator").lower()


def _imported(module: str, name: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the emulator {name} can't be imported: {error}", hint="is it installed, or on the path?"
        ) from error
