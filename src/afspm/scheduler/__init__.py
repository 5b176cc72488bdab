"""The Microscope Scheduler: decides which component controls the microscope, and which requests reach it.

**Theory of operation.** One function without input or output decides everything (`scheduler_core`):
`step(state, event, env, now_s, now_ns) -> (state, effects)`. Only the packet cache in `env` changes in
place. The shell around the function (`shell`) turns messages into events. It writes the effects to disk
(`write_ahead`), and then carries them out.

Each part of the state is a frozen dataclass, and its transitions are methods, which return the next part: half as long
as an event class for each transition, and type-checked at each call. After a step the saved parts are compared with the
parts before, and a difference becomes the first effect, so no decision has to remember saving. This costs 50 µs for
each request. The packet cache changes in place, since a copy for each packet would cost more than all decisions.

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

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:  # a coordinate frame is asked about every event, and answers in its own outputs
    from afspm.model.drift_removal import undistorted
    from afspm.model.positions import PROBE_CHANGES, REGION_CHANGES, scan_values
    from afspm.scheduler.control.arbitration import ArbitrationState
    from afspm.scheduler.coordinate_frame import (
        AskMicroscope,
        FrameOutput,
        HoldControl,
        MappedRequest,
        Reconsider,
        SaveNow,
    )
    from afspm.scheduler.events import (
        Announced,
        Codec,
        ControlChanged,
        Delegate,
        FrameAnswered,
        FrameReported,
        Input,
        Log,
        PacketIn,
        ProblemSeen,
        RequestIn,
        Started,
        Tick,
        TranslatorCaughtUp,
        TranslatorUp,
    )
    from afspm.scheduler.safety.parameter_values import number_of
    from afspm.scheduler.scheduler import Coordinates, Scheduler
    from afspm.scheduler.wire_codec import WireCodec

if TYPE_CHECKING:  # an agent's plan is checked against the limits before a person sees it
    from afspm.scheduler.safety.limits import ExperimentLimits

if TYPE_CHECKING:  # a replay gives a scheduler its recorded steps
    from afspm.scheduler.saved_state import SavedState
    from afspm.scheduler.scheduler_core import SchedulerCore

__all__ = [
    "PROBE_CHANGES",
    "REGION_CHANGES",
    "Announced",
    "ArbitrationState",
    "AskMicroscope",
    "Codec",
    "ControlChanged",
    "Coordinates",
    "Delegate",
    "ExperimentLimits",
    "FrameAnswered",
    "FrameOutput",
    "FrameReported",
    "HoldControl",
    "Input",
    "Log",
    "MappedRequest",
    "PacketIn",
    "ProblemSeen",
    "Reconsider",
    "RequestIn",
    "SaveNow",
    "SavedState",
    "Scheduler",
    "SchedulerCore",
    "Started",
    "Tick",
    "TranslatorCaughtUp",
    "TranslatorUp",
    "WireCodec",
    "number_of",
    "scan_values",
    "undistorted",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.model.drift_removal": "undistorted",
            "afspm.model.positions": "PROBE_CHANGES REGION_CHANGES scan_values",
            "afspm.scheduler.control.arbitration": "ArbitrationState",
            "afspm.scheduler.coordinate_frame": (
                "AskMicroscope FrameOutput HoldControl MappedRequest Reconsider SaveNow"
            ),
            "afspm.scheduler.events": (
                "Announced Codec ControlChanged Delegate FrameAnswered FrameReported Input Log PacketIn "
                "ProblemSeen RequestIn Started Tick TranslatorCaughtUp TranslatorUp"
            ),
            "afspm.scheduler.safety.limits": "ExperimentLimits",
            "afspm.scheduler.safety.parameter_values": "number_of",
            "afspm.scheduler.saved_state": "SavedState",
            "afspm.scheduler.scheduler": "Coordinates Scheduler",
            "afspm.scheduler.scheduler_core": "SchedulerCore",
            "afspm.scheduler.wire_codec": "WireCodec",
        },
    )
