"""Supervision of an experiment's processes: start, watch and restart them, and end the run.

**Theory of operation.** The decisions are pure (`supervision/`): events and real monotonic times in, effects out. The
loop around them (`supervisor`) waits in one poller for heartbeats, exits, output, signals and the next deadline.

    comes in      an `Experiment`; heartbeats; exits and output of children; Ctrl-C; orders that the scheduler relays
    state         for each child: its starts, its phase, its last heartbeat (`supervised_child`)
    goes out      children started, killed, asked to end; states of processes and log lines to the scheduler; the run
                  folder
    always holds  a process counts as hanging if its heartbeats stop or one step exceeds its limit, never because the
                  computer slept (`supervision/liveness`); no child outlives its supervisor (`reaper`); the microscope
                  is left safe
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.supervisor.own_runs import register_own_messages
    from afspm.supervisor.ports import FreePorts
    from afspm.supervisor.resume import ResumableRun
    from afspm.supervisor.run import RunOptions
    from afspm.supervisor.run import run as run_experiment

if TYPE_CHECKING:  # a page rehearses runs
    from afspm.supervisor.run import dry_run

__all__ = [
    "FreePorts",
    "ResumableRun",
    "RunOptions",
    "dry_run",
    "register_own_messages",
    "run_experiment",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.supervisor.own_runs": "register_own_messages",
            "afspm.supervisor.ports": "FreePorts",
            "afspm.supervisor.resume": "ResumableRun",
            "afspm.supervisor.run": "RunOptions dry_run",
        },
        run_experiment="afspm.supervisor.run.run",
    )
