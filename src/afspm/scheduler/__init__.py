"""The Microscope Scheduler: decides who controls the microscope, and which requests reach it.

**Theory of operation.** One pure function decides everything: `step(state, event, now) -> (state, effects)`
(`scheduler_core`). The shell around it (`shell`) turns messages into events and carries the effects out, after it has
written them down (`write_ahead`).

    comes in      requests of components; packets and answers of the translator; connections; time
    state         `SchedulerState`: control, problems, the queue to the translator, values in force, lease, event log;
                  frozen, replaced at every step
    goes out      one request at a time to the translator; an answer to each request; packets to all subscribers, with a
                  time and an envelope
    always holds  one holder of control at most; every request gets one answer, and none is executed twice; nothing is
                  sent that the limits forbid at the moment of sending; a packet is in the log before anybody receives
                  it

    folder         decides
    `control/`     who is in control: the arbitration table, leases, problems, the begin and the end of an experiment
    `requests/`    a request from its arrival to its answer, in five stages
    `safety/`      limits, and what the scheduler itself does for the tip when a holder dies
    `publishing/`  envelopes, times, the cache for late joiners, the event log

A coordinate frame may translate between what components and the microscope speak of (`coordinate_frame`); without a
plug-in it is the microscope's own.
"""

from __future__ import annotations

from afspm.scheduler.scheduler import Scheduler

__all__ = ["Scheduler"]
