"""One Python class of an experiment, hosted in this process: its log, heartbeats, connections and exit code."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

from afspm import wire
from afspm.basics.clock import Clock, ExperimentClock
from afspm.basics.errors import ConfigError
from afspm.basics.exit_codes import ExitCode
from afspm.basics.launch import Launch
from afspm.model import ProcessStates
from afspm.transport import Port
from afspm.transport.heartbeat import HeartbeatSender
from afspm.transport.network import Network
from afspm.transport.port import ParentGone
from afspm.transport.process import failure, log
from afspm.transport.process.context import (
    DEFAULT_LONGEST_STEP_S,
    ProcessActivity,
    ProcessContext,
    new_session,
)
from afspm.transport.process.loading import load
from afspm.transport.process.parent import ParentWatch, StopRequested, call_at_signal
from afspm.transport.zmq_port import open_port
from afspm.wire.message_types import register_all

LOADED_WITHIN_S = 300.0  # for a large library on a slow disk, the weights of a network
MOST_FILES = 65_536  # plenty; child programs that loop over all possible descriptors would take long with more


def run(launch_line: bytes, pipe: int) -> int:
    """Run the class that a launch line names, and return the exit code.

    Args:
        pipe: descriptor that the launch line came from; the parent holds its other end.
    """
    try:
        launch = Launch.from_json(launch_line)
    except ConfigError as error:
        log.set_up("host", "INFO").error("%s", error)
        return ExitCode.CONFIG
    logger = log.set_up(launch.name, launch.log_level)
    _allow_many_connections()
    parent = ParentWatch(pipe, ExitCode.ORPHAN)
    parent.watch()
    call_at_signal(signal.SIGTERM, parent.let_go)
    try:
        return _host(launch, logger, parent)
    except ConfigError as error:
        logger.error("%s", error)
        return ExitCode.CONFIG
    except StopRequested:
        return ExitCode.ORPHAN
    except Exception as error:  # a component may raise anything: logged here, and the exit code has it restarted
        if parent.gone:
            logger.debug("while ending: %s", error, exc_info=True)
            return ExitCode.ORPHAN
        failure.log(logger, error, launch.name)
        return ExitCode.CRASHED


def _host(launch: Launch, logger: logging.Logger, parent: ParentWatch) -> int:
    clock = ExperimentClock.from_dict(launch.clock)
    activity = ProcessActivity(clock)
    activity.longest_step_s = LOADED_WITHIN_S  # before the first heartbeat: imports may block the next ones
    with _beating(launch, activity, logger):
        with activity.step():
            register_all(launch.messages)
            process = load(launch)
        activity.longest_step_s = DEFAULT_LONGEST_STEP_S
        context = ProcessContext(
            launch,
            clock,
            open_port=lambda heard=None: _open_port(launch, clock, parent, heard),
            log=logger,
            activity=activity,
            when_stopping=parent.when_gone,
            tip_in_danger=parent.tip_in_danger,
            session=new_session(launch.run),
        )
        return process.run_process(context)


@contextmanager
def _beating(launch: Launch, activity: ProcessActivity, logger: logging.Logger) -> Iterator[None]:
    # only an end on purpose is announced; after an error the supervisor sees the beats stop
    if launch.sockets.heartbeat is None:
        yield
        return
    sender = HeartbeatSender(
        launch.sockets.heartbeat,
        launch.beat_period_s,
        _watched_age_s(activity, logger),
        lambda: activity.longest_step_s,
        launch.beat_token,
        Network.connecting(launch.name, launch.keys),
    )
    yield
    sender.close()


def _watched_age_s(activity: ProcessActivity, logger: logging.Logger) -> Callable[[], float]:
    # the thread of the heartbeats calls it: it runs while a step hangs, and can log where before the supervisor kills
    logged_since_s: float | None = None

    def age_s() -> float:
        nonlocal logged_since_s
        since_s, age_s = activity.since_s, activity.age_s()
        if age_s > activity.longest_step_s and since_s != logged_since_s:
            logged_since_s = since_s
            where = failure.where_now(threading.main_thread().ident or 0)
            longest = f"longer than longest_step_s = {activity.longest_step_s:g} s"
            logger.error("a step takes %s, and counts as frozen; it is at\n%s", longest, where)
        return age_s

    return age_s


def _open_port(launch: Launch, clock: Clock, parent: ParentWatch, heard: tuple[str, ...] | None) -> Port:
    envelopes = wire.messages_of_the_experiment() if launch.envelopes is None else launch.envelopes
    if heard is not None:
        envelopes = heard
    elif launch.sockets.control is not None:
        of_loop = (*wire.followed_messages(), *([ProcessStates.__name__] if launch.after else []))
        envelopes = tuple(sorted({*envelopes, *of_loop}))
    launch = replace(launch, envelopes=envelopes)
    port = open_port(launch, clock)
    parent.when_gone(lambda: port.wake_up(ParentGone()))
    return port


def _allow_many_connections() -> None:
    # strangers that connect use up the usual thousand open files, and then no file can be written
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_FILES if hard == resource.RLIM_INFINITY else min(MOST_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
