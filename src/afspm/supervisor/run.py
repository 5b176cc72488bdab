"""A whole run of an experiment: check, folder, start, supervision, summary."""

from __future__ import annotations

import logging
import platform
import sqlite3
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TextIO

from afspm.basics.addresses import connectable
from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import AfspmError, ConfigError
from afspm.basics.formatting import counted, duration_text
from afspm.basics.launch import Launch, Sockets
from afspm.client import GUEST
from afspm.client.connect import guest_facts
from afspm.experiment import Experiment, ProcessStart, Role
from afspm.model.events import LOGGED_AS
from afspm.record import lock_run
from afspm.record.run_json import (
    COMPUTER,
    ENDED,
    FEEDBACK_OFF,
    LOST_WITHOUT,
    METADATA,
    NEVER_SHOWN,
    PLANNED,
    REAL_S,
    SOLVES,
    STATE_DIR,
    UNFINISHED,
    WAITS_GIVEN_UP,
    run_json_or_empty,
)
from afspm.record.run_lock import writing_to
from afspm.storage import log_folder
from afspm.storage.disk import run_bounded
from afspm.storage.packet_log import discard_if_recorded, expect_recorder
from afspm.supervisor import key_handout, own_runs, post_run, run_folder, run_identity
from afspm.supervisor.log import RunLog
from afspm.supervisor.ports import FreePorts, new_addresses, require_free, require_limits
from afspm.supervisor.post_run import EndedRun
from afspm.supervisor.process import from_start
from afspm.supervisor.reporter import reporter_of
from afspm.supervisor.run_identity import RunIdentity
from afspm.supervisor.supervision.child import ChildPolicy, RestartPolicy
from afspm.supervisor.supervision.liveness import LivenessPolicy
from afspm.supervisor.supervisor import TOLERANCE_S, RunOutcome, Supervisor
from afspm.transport.heartbeat import HeartbeatListener

TAKES_WHO_COMES = ""
"""Run identity for a real microscope's translator that is started alone: it obeys any scheduler that connects."""
RUN, HOW, FILES, ONLY, WITHOUT = "run", "how", "files", "only", "without"

# a hanging disk must not keep the supervisor from ending
WRITTEN_WITHIN_S = 5.0
RECORDED_WITHIN_S = 40.0


CLOCK_FILE = "clock"


@dataclass(frozen=True)
class RunOptions:
    """Options of a run that are not in the experiment file.

    Attributes:
        runs: the folder of run folders.
        only, without: names of processes to start, or not to start, on this computer.
        speed: experiment seconds in a real second, instead of the file's; for simulated microscopes only.
        report: whether to write the report at the end.
        metadata: entries that override [metadata] of the file.
        feedback_off: whether a person says that the z feedback is off by intention at this start.
        log_level: lowest level of log lines, of `logging`, for the processes and the terminal.
    """

    runs: Path = Path("runs")
    only: Collection[str] = ()
    without: Collection[str] = ()
    speed: float | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)
    report: bool = True
    feedback_off: bool = False
    log_level: int = logging.INFO


@dataclass(frozen=True)
class FinishedRun:
    """Folder and outcome of a run that has ended."""

    folder: Path
    outcome: RunOutcome


def run(experiment: Experiment, options: RunOptions = RunOptions(), terminal: TextIO | None = None) -> FinishedRun:
    """Run an experiment until it ends.

    Raises:
        ConfigError: the experiment file has errors, or the options don't fit it; nothing was started.
        FileError: the run folder can't be made or written; nothing was started.
    """
    experiment.require_valid(options.only, options.without)
    own = _own_identity(experiment, options)
    # errors are raised before the folder is made
    first = _starts(experiment, options, own, FreePorts().address)
    key_handout.hand_over(experiment, first)
    names = [start.launch.name for start in first]
    require_free(addresses_of(first))
    require_limits(len(first))
    common = common_identity(experiment, first, own, options, terminal)
    folder = run_folder.create(options.runs, experiment.name, run_folder.now())
    with lock_run(folder):
        with writing_to(folder):
            run_folder.write_experiment(folder, experiment.expanded(secrets=False))
        return go(experiment, options, common, folder, experiment.name, terminal, names)


def go(
    experiment: Experiment,
    options: RunOptions,
    common: RunIdentity,
    folder: Path,
    name: str,
    terminal: TextIO | None,
    names: Sequence[str],
) -> FinishedRun:
    """Run an experiment in an existing, locked folder until it ends.

    Args:
        name: name of the experiment.
        names: names of its processes.

    Raises:
        FileError: the folder can't be written; nothing was started.
    """
    with writing_to(folder):
        if experiment.resolved.sections.clock.waits:
            common = replace(common, clock=common.clock.waiting_in(folder / STATE_DIR / CLOCK_FILE))
        clock = common.clock
        run_log = RunLog(folder / run_folder.LOG_FILE, clock, terminal=terminal, level=options.log_level, names=names)
    security = experiment.resolved.sections.security
    new = new_addresses(private=security.are_sockets_private, tcp=security.tcp)
    with closing(run_log) as log, new as addresses:
        starts = _starts(experiment, options, common, addresses.of_socket, folder)
        before = run_json_or_empty(folder)  # empty unless the run is resumed
        files = before.get(FILES) or list(map(str, experiment.files))
        facts = {**run_facts(name, starts, common), **facts_to_resume(experiment, starts, options), FILES: files}
        if said := [*before.get(FEEDBACK_OFF, ()), *([clock.now_ns()] if options.feedback_off else [])]:
            facts[FEEDBACK_OFF] = said
        facts |= own_runs.signed(folder, [*map(str, experiment.folders)])
        facts[METADATA] = before.get(METADATA) or experiment.resolved.metadata() | dict(options.metadata)
        facts[NEVER_SHOWN] = experiment.resolved.never_shown()
        facts[LOST_WITHOUT] = lost = list(experiment.resolved.lost_without())
        works = experiment.planned_work().items()
        facts[PLANNED] = before.get(PLANNED) or {name: work and work.as_dict() for name, work in works}
        if before.get(ENDED) and REAL_S in before:
            facts[REAL_S] = before[REAL_S]
        handed = key_handout.hand_over(experiment, starts)
        # before run.json: a program that finds it may join at once
        with handed.laid_down(folder):
            with writing_to(folder):
                run_folder.write_run(folder, facts)
                if {start.launch.name for start in starts} & set(experiment.recorders):
                    expect_recorder(log_folder(folder / STATE_DIR))
            log.write(LOGGED_AS, logging.INFO, f"{name}: {counted(len(starts), 'process', 'processes')}, into {folder}")
            for one in lost:
                log.write(LOGGED_AS, logging.WARNING, one)
            if not common.simulated and (warning := _ahead_of_wall(clock)):
                log.write(LOGGED_AS, logging.WARNING, warning)
            reporter = reporter_of(experiment, starts, clock, common.run, handed.supervisor)
            tasks = [from_start(start) for start in handed.starts]
            ends_idle = experiment.ends_idle([task.name for task in tasks])
            encrypts = not security.insecure
            beats = HeartbeatListener(take_address=addresses.of_heartbeat, encrypts=encrypts)
            supervisor = Supervisor(tasks, log, clock, _child_policy(experiment), reporter, beats, ends_idle=ends_idle)
            outcome = supervisor.run()
        try:
            ending = {**facts, ENDED: outcome.text, HOW: outcome.why.name.lower()}
            if unfinished := {report.name: report.unfinished for report in outcome.reports if report.unfinished}:
                ending[UNFINISHED] = unfinished
            if given_up := before.get(WAITS_GIVEN_UP, 0) + outcome.waits_given_up:
                ending[WAITS_GIVEN_UP] = given_up
            if not before or REAL_S in facts:  # without REAL_S an earlier part was cut off at an unknown time
                so_far_s = before.get(REAL_S, 0.0)
                ending[REAL_S] = round(so_far_s + outcome.duration_s, 1)
            run_bounded(lambda: run_folder.write_run(folder, ending), WRITTEN_WITHIN_S)
        except OSError as error:  # a full disk must not prevent the notification of the end
            log.write(LOGGED_AS, logging.ERROR, f"how it ended is not in run.json: {error}")
        if outcome.why.is_final:
            recorders = [start.launch for start in starts if start.launch.name in experiment.recorders]
            with suppress(OSError):  # leftover files only take space
                run_bounded(lambda: _discard_log(folder, recorders, clock, log), RECORDED_WITHIN_S)
        ended = EndedRun(name, folder, outcome, common.simulated)
        post_run.follow(experiment, ended, starts, clock, log, with_report=options.report)
    return FinishedRun(folder, outcome)


def _discard_log(folder: Path, recorders: Sequence[Launch], clock: ExperimentClock, log: RunLog) -> None:
    from afspm.components.recorder import record_last_reports

    try:
        for launch in recorders:
            record_last_reports(launch, clock)
    except (AfspmError, OSError, sqlite3.Error) as error:
        log.write(LOGGED_AS, logging.WARNING, f"the last reports of processes are not in the record: {error}")
    discard_if_recorded(log_folder(folder / STATE_DIR))


def _ahead_of_wall(clock: ExperimentClock) -> str:
    # of a resumed run, see `resume`, or of a scheduler on another computer; empty if the run has the wall clock
    ahead_s = clock.now_s() - ExperimentClock.real().now_s()
    if clock.origin_s == clock.start_s or ahead_s < TOLERANCE_S:
        return ""
    behind = f"the computer's clock is {duration_text(ahead_s)} behind the run's clock"
    return f"{behind}, which is never set back; the record keeps the run's own time"


def addresses_of(starts: Sequence[ProcessStart]) -> dict[str, str]:
    return {
        address: start.launch.name
        for start in starts
        for address in (start.launch.sockets.publish, start.launch.sockets.serve)
        if address is not None
    }


def facts_to_resume(experiment: Experiment, starts: Sequence[ProcessStart], options: RunOptions) -> dict[str, object]:
    """Return the names in run.json that are needed to resume the run.

    Implied processes, such as the recorder, are listed by name like all others.
    """
    here = [start.launch.name for start in starts]
    elsewhere = [name for name in experiment.component_names if name not in here]
    return {
        ONLY: here if options.only else [],
        WITHOUT: elsewhere if options.without and not options.only else [],
    }


def dry_run(experiment: Experiment, options: RunOptions = RunOptions()) -> list[ProcessStart]:
    """Return the processes that `run` would start, and start no process. Raises ConfigError as `run` does."""
    experiment.require_valid(options.only, options.without)
    return _starts(experiment, options, _own_identity(experiment, options), FreePorts().address)


def run_facts(name: str, starts: Sequence[ProcessStart], common: RunIdentity) -> dict[str, object]:
    """Return the contents of run.json: processes, addresses, and the launch line for guests (`afspm.connect`)."""
    facts: dict[str, object] = {
        "name": name,
        RUN: common.run,
        "simulated": common.simulated,
        COMPUTER: platform.node(),
        "clock": common.clock.as_dict(),
        "processes": {
            start.launch.name: {
                "role": start.role.value,
                "publish": start.launch.sockets.publish,
                "serve": start.launch.sockets.serve,
                **({SOLVES: start.solves} if start.solves else {}),
            }
            for start in starts
        },
    }
    host = _example_of_a_guest(starts)
    return facts if host is None else {**facts, GUEST: guest_facts(host)}


def _example_of_a_guest(starts: Sequence[ProcessStart]) -> Launch | None:
    by_role = {start.role: start.launch for start in reversed(starts)}
    scheduler = by_role.get(Role.SCHEDULER)
    if scheduler is None or scheduler.sockets.publish is None or scheduler.sockets.serve is None:
        component = by_role.get(Role.COMPONENT)
        return component if component and component.sockets.subscribe and component.sockets.control else None
    sockets = Sockets(subscribe=(connectable(scheduler.sockets.publish),), control=connectable(scheduler.sockets.serve))
    keys = scheduler.keys
    if keys is not None and "folder" in keys:  # the scheduler's own key is expected there
        keys = {**keys, **dict.fromkeys((*sockets.subscribe, str(sockets.control)), scheduler.name)}
    return replace(scheduler, sockets=sockets, keys=keys)


def _starts(
    experiment: Experiment,
    options: RunOptions,
    common: RunIdentity,
    take_address: Callable[[], str],
    folder: Path | None = None,
) -> list[ProcessStart]:
    starts = experiment.launches(
        take_address=take_address,
        only=options.only,
        without=options.without,
        clock=common.clock.as_dict(),
        run=common.run,
        simulated=common.simulated,
        run_dir=str(folder or ""),
        state_dir=str(folder / STATE_DIR) if folder else "",
        log_level=logging.getLevelName(options.log_level),
    )
    if not starts:
        raise ConfigError("nothing is left to start", hint="see --only and --without")
    if options.feedback_off:
        starts = [_with_feedback_off(start, common.clock.now_ns()) for start in starts]
        if not any(start.launch.feedback_off for start in starts):
            hint = "say it where the translator is started"
            raise ConfigError("no translator is started here", where="--feedback-off", hint=hint)
    return starts


def _with_feedback_off(start: ProcessStart, now_ns: int) -> ProcessStart:
    # of this start alone: a restarted translator gets the same text, and in a resumed run it gets another one
    is_translator = start.role is Role.TRANSLATOR
    return replace(start, launch=replace(start.launch, feedback_off=str(now_ns))) if is_translator else start


def _own_identity(experiment: Experiment, options: RunOptions) -> RunIdentity:
    simulated = experiment.simulated(options.only, options.without)
    clock, speed = experiment.clock(), options.speed
    if speed is not None and not experiment.resolved.simulated:
        raise ConfigError("a real microscope has real time", where="--speed", hint="omit --speed")
    if speed is not None:
        clock = replace(clock, speed=speed)
    return RunIdentity(clock, run_identity.new_identity(), simulated)


def common_identity(
    experiment: Experiment,
    starts: Sequence[ProcessStart],
    own: RunIdentity,
    options: RunOptions,
    terminal: TextIO | None,
) -> RunIdentity:
    """Return the identity of the whole run, from the scheduler if the scheduler is started elsewhere.

    Raises:
        ConfigError: time is simulated, but the microscope may be real; or the speed differs from the scheduler's.
    """
    roles = {start.launch.name: start.role for start in starts}
    launch = None if Role.SCHEDULER in roles.values() else experiment.asking(list(roles))
    if launch is None:
        if own.simulated:
            return own
        _require_real_time(own.clock, experiment)
        return own if Role.SCHEDULER in roles.values() else replace(own, run=TAKES_WHO_COMES)
    if Role.COMPONENT not in roles.values() and not experiment.resolved.simulated:
        return replace(own, run=TAKES_WHO_COMES)
    common = run_identity.ask_scheduler(launch, lambda text: print(text, file=terminal, flush=True))
    if options.speed is not None and common.clock.speed != options.speed:
        raise ConfigError(
            f"the experiment goes at {common.clock.speed:g}",
            where="--speed",
            hint="it is set where the scheduler is started",
        )
    return replace(common, simulated=own.simulated or common.simulated)


def _require_real_time(clock: ExperimentClock, experiment: Experiment) -> None:
    if clock.speed != 1.0 or experiment.resolved.sections.clock.start is not None:
        raise ConfigError(
            "the experiment has a simulation's time, and nothing here proves that its microscope is simulated",
            where="[clock]",
            hint="start the translator together with its emulator, or set the speed to 1",
        )


def _child_policy(experiment: Experiment) -> ChildPolicy:
    r = experiment.resolved.sections.restart
    return ChildPolicy(
        LivenessPolicy(r.beat_period, r.missed_beats, r.start, r.longest_step, r.closing),
        RestartPolicy(r.budget, r.window, r.first_delay, longest_delay_s=r.longest_delay, healthy_s=r.healthy),
    )
