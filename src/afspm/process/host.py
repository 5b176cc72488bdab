"""`python -m afspm.process.host`: hosts one process of an experiment, as the line on its standard input says."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from afspm import wire
from afspm.clock import Clock, ExperimentClock
from afspm.errors import ConfigError
from afspm.exit_codes import ExitCode
from afspm.launch import Launch
from afspm.process import failure, log
from afspm.process.context import (
    DEFAULT_LONGEST_STEP_S,
    MEASURED_MESSAGES,
    STATE_MESSAGES,
    ProcessActivity,
    ProcessContext,
    new_session,
)
from afspm.process.loading import load
from afspm.process.message_types import register_all
from afspm.process.parent import ParentWatch, StopRequested, end_within, read_launch_line
from afspm.transport.heartbeat import HeartbeatSender
from afspm.transport.port import ParentGone, Port
from afspm.transport.zmq_port import open_port

LOADED_WITHIN_S = 300.0  # a large library off a slow disk, the weights of a network
FAREWELL_S = 1.0  # that exit handlers and threads of libraries have, once everything of ours is done
MOST_FILES = 65_536  # more than anybody needs; some programs that are started by ours walk through all that may be


def main() -> int:
    """Returns the exit code, with which the caller is to end the process."""
    # Ctrl-C reaches the whole terminal; whether it ends us is the parent's decision
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        launch = Launch.from_json(read_launch_line())
    except ConfigError as error:
        log.set_up("host", "INFO").error("%s", error)
        return ExitCode.CONFIG
    logger = log.set_up(launch.name, launch.log_level)
    _allow_many_connections()
    parent = ParentWatch(ExitCode.ORPHAN)
    parent.watch()
    signal.signal(signal.SIGTERM, lambda *_: parent.let_go())
    _detach_stdin()
    try:
        return _host(launch, logger, parent)
    except ConfigError as error:
        logger.error("%s", error)
        return ExitCode.CONFIG
    except StopRequested:
        return ExitCode.ORPHAN
    except Exception as error:
        if parent.gone:
            logger.debug("while ending: %s", error, exc_info=True)
            return ExitCode.ORPHAN
        logger.error("%s", failure.describe(error, launch.name))
        logger.debug("the same with every step of ours", exc_info=True)
        return ExitCode.CRASHED


def _host(launch: Launch, logger: logging.Logger, parent: ParentWatch) -> int:
    clock = ExperimentClock.from_dict(launch.clock)
    activity = ProcessActivity(clock)
    activity.longest_step_s = LOADED_WITHIN_S  # before the first beat: it may be the last until all is loaded
    with _beating(launch, activity, logger):
        with activity.step():
            register_all(launch.messages)
            process = load(launch)
        activity.longest_step_s = DEFAULT_LONGEST_STEP_S
        context = ProcessContext(
            launch,
            clock,
            open_port=lambda: _open_port(launch, clock, parent),
            log=logger,
            activity=activity,
            when_stopping=parent.when_gone,
            tip_in_danger=parent.tip_in_danger,
            session=new_session(launch.run),
        )
        return process.run_process(context)


@contextmanager
def _beating(launch: Launch, activity: ProcessActivity, logger: logging.Logger) -> Iterator[None]:
    """Heartbeats while in the block. Only an end on purpose is announced: after an error the silence tells."""
    if launch.sockets.heartbeat is None:
        yield
        return
    sender = HeartbeatSender(
        launch.sockets.heartbeat,
        launch.beat_period_s,
        _Watch(activity, logger).age_s,
        lambda: activity.longest_step_s,
        launch.beat_token,
    )
    yield
    sender.close()


class _Watch:
    """Says where a step hangs, before the beat that has the process killed for it."""

    def __init__(self, activity: ProcessActivity, logger: logging.Logger) -> None:
        self._activity = activity
        self._log = logger
        self._told_since_s: float | None = None

    def age_s(self) -> float:
        """Called in the thread of the heartbeats."""
        since_s, age_s = self._activity.since_s, self._activity.age_s()
        if age_s > self._activity.longest_step_s and since_s != self._told_since_s:
            self._told_since_s = since_s
            where = failure.where_now(threading.main_thread().ident or 0)
            longest = f"longer than longest_step_s = {self._activity.longest_step_s:g} s"
            self._log.error("a step takes %s, and counts as frozen; it is at\n%s", longest, where)
        return age_s


def _open_port(launch: Launch, clock: Clock, parent: ParentWatch) -> Port:
    """The port of a component: hears, besides what it subscribed to, what `Scope` has to know."""
    envelopes = wire.messages_of_the_experiment() if launch.envelopes is None else launch.envelopes
    if launch.sockets.control is not None:
        envelopes = tuple(sorted({*envelopes, *STATE_MESSAGES, *MEASURED_MESSAGES}))
    launch = replace(launch, envelopes=envelopes)
    port = open_port(launch, clock)
    parent.when_gone(lambda: port.wake_up(ParentGone()))
    return port


def _allow_many_connections() -> None:
    """As many open files as the system lets us have: by default a thousand, which strangers that connect use up; then
    nothing could be written to disk any more."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_FILES if hard == resource.RLIM_INFINITY else min(MOST_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _detach_stdin() -> None:
    """What a component reads from sys.stdin is not what keeps us alive."""
    sys.stdin = Path(os.devnull).open(encoding="utf-8")  # noqa: SIM115 - as long as the process lives


if __name__ == "__main__":
    exit_code = int(main())
    end_within(FAREWELL_S, exit_code)
    sys.exit(exit_code)
