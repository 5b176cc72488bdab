"""Translator and scheduler of an experiment file, started or already running, and a connection to them."""

from __future__ import annotations

import logging
import signal
import tempfile
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

from afspm.basics.addresses import connectable
from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch, Sockets
from afspm.client.component import Component
from afspm.client.experiment_link import ExperimentLink
from afspm.driver import Driver
from afspm.experiment import Experiment, ProcessStart, Role, load
from afspm.model import Frame, names
from afspm.model.events import LOGGED_AS
from afspm.record.run_json import STATE_DIR
from afspm.supervisor import run_folder, run_identity
from afspm.supervisor.log import RunLog
from afspm.supervisor.ports import FreePorts, require_free
from afspm.supervisor.run import addresses_of
from afspm.supervisor.run_identity import RunIdentity
from afspm.testing.conformance import Lost
from afspm.testing.processes import Processes
from afspm.testing.translators.client import CheckClient
from afspm.testing.translators.support import Support, find_out
from afspm.translator.judge import SETTINGS
from afspm.translator.parameters import ParameterSpec, ParameterTable
from afspm.translator.setting_groups import FRAME
from afspm.transport import Port
from afspm.transport.port import ParentGone
from afspm.transport.process.context import new_session
from afspm.transport.zmq_port import open_port

NAME = "translator_test"
SPEED = 20.0
"""Experiment seconds in a real second of a simulated microscope: quick, but slow enough to stop a scan."""
_OVERLAY = f"""
[{NAME}]
component = true
class = "{__name__}.Tester"
"""
_SCHEDULER = """
[scheduler]
component = true
class = "Scheduler"
"""


class Tester(Component):
    """The component of the checks in the experiment, wired like any component, but not started as a process."""


@dataclass(frozen=True)
class CheckOptions:
    """The options of a pass.

    Attributes:
        files: the experiment file, and its overlays.
        without: processes that run already, at the addresses in the file, and are joined.
        runs: the parent of the run folders.
        speed: experiment seconds per real second, for a simulated microscope.
        only: parts of the names of the checks; empty: all.
        frame_m: the side of a square about the centre of the set frame, never left by checks; None: the set frame.
        patience: a factor of all limits in real time.
    """

    files: Sequence[Path]
    without: Collection[str] = ()
    runs: Path = Path("runs")
    speed: float = SPEED
    only: Collection[str] = ()
    frame_m: float | None = None
    patience: float = 1.0


@dataclass
class CheckSession:
    """The translator under test, and the connection to it.

    Attributes:
        support: the supported actions and parameters.
        translator: class or command of the translator.
        maker: maker of the controller; empty if unknown.
        folder: the run folder.
        excused: checks that this controller can't pass, with the reason.
        complaints: the logged warnings and errors; the list grows.
        program_s: real seconds that the controller's program may need beside measuring; see `Driver.program_s`.
        counts_clockwise: True if the controller's panel shows angles clockwise.
        has_tip: False for a microscope without a tip.
        section: the translator's section in the experiment file.
        address: the controller's address; empty: unknown, or on this computer.
        rows: the driver's rows of the settings for which a measurement stands, and of the height of the tip.
        driver_folder: the folder of the driver's own files; None for a translator that is no driver.
    """

    client: CheckClient
    support: Support
    translator: str
    simulated: bool
    folder: Path
    options: CheckOptions
    excused: Mapping[str, str]
    complaints: Sequence[str]
    maker: str = ""
    program_s: float = 0.0
    counts_clockwise: bool = False
    has_tip: bool = True
    driver_folder: Path | None = None
    section: str = ""
    address: str = ""
    rows: Mapping[str, ParameterSpec] = field(default_factory=dict)


def prepare(options: CheckOptions) -> Experiment:
    """Return the experiment with the tester added, and with a scheduler if it had none.

    Raises:
        ConfigError: the experiment can't be run, or uses sample coordinates.
    """
    own = load(*options.files)
    overlay = _OVERLAY if own.resolved.with_role(Role.SCHEDULER) else _OVERLAY + _SCHEDULER
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tester.toml"
        file.write_text(overlay, encoding="utf-8")
        experiment = load(*options.files, file)
        experiment.require_valid()
    if any(scheduler.frame is Frame.SAMPLE for scheduler in experiment.resolved.with_role(Role.SCHEDULER)):
        raise ConfigError(
            "a translator is checked in tip coordinates, but this scheduler uses sample coordinates",
            where=str(options.files[0]),
            hint="give an experiment file with nothing but the microscope",
        )
    return experiment


@contextmanager
def opened(options: CheckOptions) -> Iterator[CheckSession]:
    """Start or join the program under test; hold control of the microscope within the `with` block.

    Raises:
        ConfigError: the experiment file or the options are wrong; nothing was started.
        Lost: the program did not start, or control was refused.
    """
    experiment = prepare(options)
    resolved = experiment.resolved
    (translator,) = resolved.with_role(Role.TRANSLATOR)
    with ExitStack() as stack:
        complaints: list[str] = []
        client, folder, simulated = _client(experiment, options, stack, complaints)
        stack.callback(client.end)
        stack.enter_context(_interrupting(client))
        abilities = translator.capabilities()
        actions, parameters = (abilities.actions, abilities.parameters) if abilities else ((), ())
        support = find_out(client, sorted(actions), sorted(parameters))
        named = translator.class_path or " ".join(translator.part.command)
        excused: Mapping[str, str] = {}
        maker, program_s, clockwise, folder_of_driver = "", 0.0, False, None
        rows: Mapping[str, ParameterSpec] = {}
        if translator.component is not None and issubclass(translator.component, Driver):
            driver = translator.component
            excused, maker, program_s = driver.excused(support.controller), driver.maker, driver.program_s
            clockwise, folder_of_driver = driver.counts_clockwise, driver.parameters_file.parent
            rows = _rows(driver, translator.settings.get("parameters"))
        yield CheckSession(
            client,
            support,
            named,
            simulated,
            folder,
            options,
            excused,
            complaints,
            maker,
            program_s,
            clockwise,
            has_tip(experiment),
            folder_of_driver,
            translator.name,
            "" if simulated else str(translator.settings.get("address", "")),
            rows,
        )


def _rows(driver: type[Driver], changed: object) -> dict[str, ParameterSpec]:
    table = ParameterTable.from_toml(driver.parameters_file)
    if isinstance(changed, Mapping):
        table = table.extended(changed, where="the experiment file")
    return {name: table[name] for name in (*FRAME, *SETTINGS, *table.watched, names.TIP_Z) if name in table}


@contextmanager
def _interrupting(client: CheckClient) -> Iterator[None]:
    # only the main thread receives signals
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: client.interrupt())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _client(
    experiment: Experiment, options: CheckOptions, stack: ExitStack, complaints: list[str]
) -> tuple[CheckClient, Path, bool]:
    common = _run_identity(experiment, options)
    clock = common.clock
    folder = run_folder.create(options.runs, f"test-{experiment.name}", _now())
    own, starts = _planned_starts(experiment, options, common, folder)
    require_free(addresses_of(starts))
    log = RunLog(folder / run_folder.LOG_FILE, clock, level=_NOTHING, names=[start.launch.name for start in starts])
    stack.callback(log.close)
    run_folder.write_experiment(folder, experiment.expanded(secrets=False))
    launches = [own]
    address = _translator_address(experiment, starts)
    if address is not None and not own.keys:  # with keys a translator obeys the scheduler alone
        launches.append(replace(own, sockets=Sockets(control=address), envelopes=()))
    ports = [open_port(launch, clock) for launch in launches]

    def none_goes_on() -> None:
        for port in ports:
            port.wake_up(ParentGone())

    processes = Processes(log, clock, none_goes_on, complaints)
    stack.callback(processes.close)
    for port in ports:
        stack.callback(port.close)
    processes.start(starts)
    links = [_link(port, own, _logger(log)) for port in ports]
    client = CheckClient(links[0], links[1] if len(links) > 1 else None, lambda: processes.ended, options.patience)
    try:
        client.begin()
    except Lost as lost:
        raise Lost("; ".join(filter(None, (str(lost), processes.errors)))) from lost
    return client, folder, common.simulated


_NOTHING = logging.CRITICAL + 1


def _planned_starts(
    experiment: Experiment, options: CheckOptions, common: RunIdentity, folder: Path
) -> tuple[Launch, list[ProcessStart]]:
    starts = experiment.launches(
        take_address=FreePorts().address,
        without=_left_out(experiment, options),
        clock=common.clock.as_dict(),
        run=common.run,
        simulated=common.simulated,
        run_dir=str(folder),
        state_dir=str(folder / STATE_DIR),
        log_level="DEBUG",
    )
    own = next(start.launch for start in starts if start.launch.name == NAME)
    # the tester runs in this process
    return own, [start for start in starts if start.launch.name != NAME]


def _left_out(experiment: Experiment, options: CheckOptions) -> list[str]:
    resolved = experiment.resolved
    wanted = {part.name for role in (Role.TRANSLATOR, Role.SCHEDULER) for part in resolved.with_role(role)}
    wanted |= {*resolved.emulators, NAME}
    return [name for name in experiment.component_names if name not in wanted or name in options.without]


def _translator_address(experiment: Experiment, starts: Sequence[ProcessStart]) -> str | None:
    for start in starts:
        if start.role is Role.SCHEDULER:
            return start.launch.sockets.control
        if start.role is Role.TRANSLATOR and start.launch.sockets.serve:
            return connectable(start.launch.sockets.serve)
    net = experiment.resolved.net
    keys = [net.links[part.name].control for part in experiment.resolved.with_role(Role.SCHEDULER)]
    for key in filter(None, keys):
        slot = net.slots.get(key)
        address = key if slot is None else slot.address
        return None if address is None else connectable(address)
    return None


def _link(port: Port, own: Launch, log: logging.Logger) -> ExperimentLink:
    return ExperimentLink(
        port,
        NAME,
        source=own.sockets.subscribe[0],
        session=new_session(own.run),
        request_timeout_s=own.request_timeout_s,
        request_retries=own.request_retries,
        log=log,
    )


def is_simulated(experiment: Experiment, options: CheckOptions) -> bool:
    """Return whether the microscope is known to be simulated."""
    return experiment.simulated(without=_left_out(experiment, options))


def has_tip(experiment: Experiment) -> bool:
    """Return whether the microscope may have a tip: only a driver can declare that it has none."""
    (translator,) = experiment.resolved.with_role(Role.TRANSLATOR)
    return bool(getattr(translator.component, "has_tip", True))


def _run_identity(experiment: Experiment, options: CheckOptions) -> RunIdentity:
    # a scheduler that runs already determines clock and run
    simulated = is_simulated(experiment, options)
    schedulers = {part.name for part in experiment.resolved.with_role(Role.SCHEDULER)}
    launch = experiment.asking([NAME]) if schedulers <= set(options.without) else None
    if launch is not None:
        common = run_identity.ask_scheduler(launch, logging.getLogger(__name__).warning)
        return replace(common, simulated=simulated or common.simulated)
    clock = replace(experiment.clock(), speed=options.speed) if simulated else ExperimentClock.real()
    return RunIdentity(clock, run_identity.new_identity(), simulated)


def _now() -> datetime:
    return datetime.fromtimestamp(ExperimentClock.real().now_s()).astimezone()


def _logger(log: RunLog) -> logging.Logger:
    logger = logging.Logger("afspm.translator_test")

    class Writing(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            log.write(LOGGED_AS, record.levelno, record.getMessage())

    logger.addHandler(Writing())
    return logger
