"""The Microscope Scheduler: decides which component controls the microscope, and which requests reach it.

**Theory of operation.** One function without input or output decides everything (`scheduler_core`):
`step(state, event, env, now_s, now_ns) -> (state, effects)`. Only the packet cache in `env` changes in
place. The shell around the function (`shell`) turns messages into events. It writes the effects to disk
(`write_ahead`), and then carries them out.

    comes in      requests of components; packets and answers of the translator; connections; time
    state         `SchedulerState`: control, problems, the queue to the translator, values in force, lease, event log;
                  frozen, replaced at every step
    goes out      one request at a time to the translator; an answer to each request; packets to all subscribers, with a
                  time and an envelope
    always holds  at most one component is in control; every request gets one answer if its client stays connected,
                  and none is executed twice; the limits hold at the moment of sending; while the disk works, a packet
                  is in the log before any subscriber receives it

    folder          decides
    `control/`      control: the arbitration table, leases, problems, the start and the end of an experiment
    `requests/`     a request from its arrival to its answer, in five stages
    `safety/`       limits, approvals of agents, and the scheduler's own actions for the tip when a holder dies
    `publishing/`   envelopes, times, the cache for late joiners, the event log
    `instruments/`  readings and orders of other instruments, and conditions for measuring

A coordinate frame may translate between the coordinates of components and the coordinates of the microscope
(`coordinate_frame`). Without a plug-in both are the same.
"""

from __future__ import annotations

from afspm.scheduler.scheduler import Scheduler

__all__ = ["Scheduler"]
