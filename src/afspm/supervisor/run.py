"""A whole run of an experiment: checked, its folder made, started, watched, and summed up."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TextIO

from afspm.clock import ExperimentClock
from afspm.errors import ConfigError
from afspm.experiment import Experiment, Role, Start
from afspm.logic.supervision import Policy
from afspm.runtime.connect import guest_facts
from afspm.supervisor import run_folder, summary
from afspm.supervisor.log import SUPERVISOR, RunLog
from afspm.supervisor.ports import FreePorts
from afspm.supervisor.supervisor import Outcome, Supervisor
from afspm.supervisor.task import from_start


@dataclass(frozen=True)
class Options:
    """How to run an experiment here and now, as far as the experiment file is not about it.

    Attributes:
        runs: the folder of run folders.
        only, without: names of processes to start, or not to start, on this computer.
        speed: experiment seconds in a real second, instead of the file's; for simulated microscopes only.
        log_level: of `logging`; what is shown in the terminal, and what the processes write at all.
    """

    runs: Path = Path("runs")
    only: Collection[str] = ()
    without: Collection[str] = ()
    speed: float | None = None
    log_level: int = logging.INFO


@dataclass(frozen=True)
class Run:
    """What came of a run."""

    folder: Path
    outcome: Outcome


def run(experiment: Experiment, options: Options = Options(), terminal: TextIO | None = None) -> Run:
    """Run an experiment until it ends.

    Raises:
        ConfigError: the experiment file has errors, or the options don't fit it; nothing was started.
        FileError: there is no place for the run folder; nothing was started.
    """
    experiment.require_valid()
    clock = _clock(experiment, options.speed)
    _starts(experiment, options, clock, FreePorts())  # whatever is wrong is told before a folder is made
    folder = run_folder.create(options.runs, experiment.name, _now())
    log = RunLog(folder / run_folder.LOG_FILE, clock, terminal=terminal, level=options.log_level)
    try:
        starts = _starts(experiment, options, clock, FreePorts(), folder)
        run_folder.write_experiment(folder, experiment.expanded())
        run_folder.write_run(folder, run_facts(experiment.name, starts, clock))
        log.write(SUPERVISOR, logging.INFO, f"{experiment.name}: {len(starts)} processes, into {folder}")
        supervisor = Supervisor([from_start(start) for start in starts], log, clock, Policy())
        outcome = supervisor.run()
        for line in summary.lines(outcome, folder):
            log.write(SUPERVISOR, logging.INFO, line)
    finally:
        log.close()
    return Run(folder, outcome)


def dry_run(experiment: Experiment, options: Options = Options()) -> list[Start]:
    """What `run` would start, and nothing else. Raises as `run` does."""
    experiment.require_valid()
    return _starts(experiment, options, _clock(experiment, options.speed), FreePorts())


def run_facts(name: str, starts: Sequence[Start], clock: ExperimentClock) -> dict[str, object]:
    """What a script needs to know to take part in this run, for run.json.

    The launch line of a component is there as it is, so that whoever joins is connected just as that is.
    """
    by_role = {start.role: start.launch for start in starts}
    scheduler = by_role.get(Role.SCHEDULER)
    components = [start.launch for start in starts if start.role is Role.COMPONENT]
    component = next((launch for launch in components if launch.sockets.control), None)
    some = component or scheduler
    return {
        "name": name,
        "scheduler": None
        if scheduler is None
        else {"publish": scheduler.sockets.publish, "control": scheduler.sockets.serve},
        "clock": clock.as_dict(),
        "problems": dict(some.problems) if some else {},
        "guest": guest_facts(component) if component else None,
        "processes": {
            start.launch.name: {
                "role": start.role.value,
                "publish": start.launch.sockets.publish,
                "serve": start.launch.sockets.serve,
            }
            for start in starts
        },
    }


def _starts(
    experiment: Experiment, options: Options, clock: ExperimentClock, ports: FreePorts, folder: Path | None = None
) -> list[Start]:
    starts = experiment.launches(
        take_address=ports.address,
        only=options.only,
        without=options.without,
        clock=clock.as_dict(),
        run_dir=str(folder or ""),
        state_dir=str(folder / run_folder.STATE_DIR) if folder else "",
        log_level=logging.getLevelName(options.log_level),
    )
    if not starts:
        raise ConfigError("nothing is left to start", hint="see --only and --without")
    return starts


def _clock(experiment: Experiment, speed: float | None) -> ExperimentClock:
    section = experiment.resolved.clock
    if speed is not None and not experiment.resolved.simulated:
        raise ConfigError("a real microscope has real time", where="--speed", hint="leave --speed away")
    start_s = section.start.timestamp() if section.start else None
    return ExperimentClock.starting_now(start_s, section.speed if speed is None else speed)


def _now() -> datetime:
    return datetime.fromtimestamp(ExperimentClock.real().now_s()).astimezone()
