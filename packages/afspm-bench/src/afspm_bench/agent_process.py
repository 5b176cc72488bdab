"""Process of an agent written in Python, which joins the experiment, waits for the start, and calls `solve`.

Standard input holds the trial as one line of JSON, then a line with the start time. The process writes the line
"ready" to standard output after joining.
"""

from __future__ import annotations

import json
import logging
import socket
import sys
from importlib import import_module
from pathlib import Path
from typing import Final, TextIO

from afspm import Scope
from afspm.basics import Clock, ConfigError, ExperimentClock, ExperimentEnded, Launch, NoResponse, Plain
from afspm.client import ExperimentLink
from afspm.model import Frame, ProblemNames
from afspm.transport import new_session, open_port
from afspm_bench.kept_clock import KeptClock
from afspm_bench.session import BenchAgent, TrialSession

JOINED_WITHIN_S = 30.0


_SEAL: Final = (
    "this process is sealed: it may read the Python modules of the current folder, and packages with an __init__.py; "
    "name other files and folders with --read, and write into session.folder"
)


def agent_of(path: str, *, is_sealed: bool = False) -> BenchAgent:
    """Return an instance of the agent class "package.module:Class". Raises ConfigError."""
    module, _, name = path.partition(":")
    try:
        made: BenchAgent = getattr(import_module(module), name)()
    except (ImportError, AttributeError, TypeError, OSError) as error:
        # the seal may be the cause, also of a module that is not found: Python passes over folders that it can't list
        is_due_to_seal = is_sealed and isinstance(error, ImportError | OSError)
        hint = _SEAL if is_due_to_seal else 'name a class without arguments, "module:Class"'
        raise ConfigError(f"the agent {path} can't be made: {error}", hint=hint) from error
    return made


def join(launch: Launch, clock: Clock, log: logging.Logger) -> Scope:
    """Join the experiment of a launch line; unlike `afspm.connect`, read no file of the run."""
    port = open_port(launch, clock)
    link = ExperimentLink.of_launch(launch, port, new_session(launch.run), log=log)
    if not link.wait(lambda: link.connected, link.until(JOINED_WITHIN_S)):
        raise NoResponse("the scheduler does not answer", where=launch.name)
    link.wait_caught_up(link.until(JOINED_WITHIN_S))
    frame = Frame.SAMPLE if launch.sample_coordinates else Frame.TIP
    return Scope(link, ProblemNames(launch.problems), None, frame=frame)


def main(stdin: TextIO, stdout: TextIO) -> int:
    """Run one trial of an agent; return the exit code: 0, or 3 if the experiment ended first."""
    trial: Plain = json.loads(stdin.readline())
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(name)s %(levelname)s %(message)s")
    sys.path[:0] = trial["import_from"]
    agent = agent_of(trial["class"], is_sealed=trial["sealed"])
    launch, kept = Launch.from_json(json.dumps(trial["launch"])), trial["kept_clock"]
    clock: Clock
    if kept is None:
        clock = ExperimentClock.from_dict(launch.clock)
    else:
        clock = KeptClock(socket.socket(fileno=kept), launch.clock["speed"])
    with join(launch, clock, logging.getLogger("agent")) as scope:
        print("ready", file=stdout, flush=True)
        began_ns = int(stdin.readline() or 0)
        truth = trial["truth_folder"]
        session = TrialSession(
            trial["task"], scope, trial["prompt"], trial["given"], trial["documents"], clock, began_ns,
            trial["minutes"], trial["seed"], Path.cwd(), Path(truth) if truth else None,
        )  # fmt: skip
        try:
            agent.solve(session)
        except ExperimentEnded:
            logging.warning("the time of the trial was over")
            return 3
        except PermissionError:
            if trial["sealed"]:
                logging.warning(_SEAL)
            raise
    return 0


if __name__ == "__main__":
    ready, sys.stdout = sys.stdout, sys.stderr  # an agent may print
    sys.exit(main(sys.stdin, ready))
