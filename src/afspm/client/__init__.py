"""Components and scripts: the base class of users' components, its loop, and `Scope`, the blocking handle.

**Theory of operation.** A component has one thread, which waits in one place (`experiment_link`) and calls one handler
at a time (`loop`). Packets that arrive meanwhile wait in order (`backlog`). `Scope` offers blocking calls to scripts,
and handles packets while a call waits.

    comes in      packets of the scheduler, answers to requests
    state         the newest state of the experiment; a memory on disk; intent and result of each keyed measurement
    goes out      calls of `on_scan`, `on_problem` … (`dispatch`); requests, repeated with one id until they are
                  answered (`command_retry`)
    always holds  a handler is never interrupted; a keyed measurement is taken exactly once, over any number of kills
                  (`keyed_results`)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.client.connect import GUEST, find_run, guest_of
    from afspm.client.experiment_link import ExperimentLink
    from afspm.client.parameter_text import Value, to_parameter, to_settings
    from afspm.client.targets import ScanTarget, SpectrumTarget, Target, xy_of

if TYPE_CHECKING:  # a page's person measures and sets as a script does
    from afspm.client.cycle import Cycle, CycleOutcome
    from afspm.client.measurement import BEGUN_WITHIN_S
    from afspm.client.parameter_text import from_parameter, value_in
    from afspm.client.targets import FITS, is_set, target_from

__all__ = [
    "BEGUN_WITHIN_S",
    "FITS",
    "GUEST",
    "Cycle",
    "CycleOutcome",
    "ExperimentLink",
    "ScanTarget",
    "SpectrumTarget",
    "Target",
    "Value",
    "find_run",
    "from_parameter",
    "guest_of",
    "is_set",
    "target_from",
    "to_parameter",
    "to_settings",
    "value_in",
    "xy_of",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.client.connect": "GUEST find_run guest_of",
            "afspm.client.cycle": "Cycle CycleOutcome",
            "afspm.client.experiment_link": "ExperimentLink",
            "afspm.client.measurement": "BEGUN_WITHIN_S",
            "afspm.client.parameter_text": "Value to_parameter to_settings from_parameter value_in",
            "afspm.client.targets": "ScanTarget SpectrumTarget Target xy_of FITS is_set target_from",
        },
    )
