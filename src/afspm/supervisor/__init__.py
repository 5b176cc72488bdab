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
