"""Decisions without sockets, threads or clocks: an event and a time go in, effects come out.

`scheduling.SchedulerCore` is the whole of the scheduler's deciding, `supervision.ChildWatch` that of the supervisor
about one child. `arbitration.TABLE` is the transition table of control, as data.
"""
