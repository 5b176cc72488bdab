"""afspm automates scanning probe microscopes of any make.

What one writes components and scripts with is here, loaded when it is first used, so that every process starts fast.
"""

from __future__ import annotations

from importlib.machinery import PathFinder
from typing import TYPE_CHECKING, Any

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.client.component import Component
    from afspm.client.connect import connect
    from afspm.client.events import Events, PublishedEvent
    from afspm.client.scope import Scope
    from afspm.model import ControlMode, Problem, Region, Scan, ScanSet, ScopeState, Spectrum
    from afspm.night.catalogue import find_runs
    from afspm.night.run import Run, open_run
    from afspm.storage.formats import read
    from afspm.storage.memory import Memory

if TYPE_CHECKING:  # components judge tips, pair channels, plan work, keep files and states
    from afspm.basics.shared_time import Publication
    from afspm.components import tip_verdict
    from afspm.components.channel_pairs import ChannelPairing, HeightPair, MissingChannels
    from afspm.components.line_file import LineFile, csv_line
    from afspm.components.tip_judge import Opinion, TipJudge
    from afspm.model.arrays import SD_PER_MAD, Array, robust_spread
    from afspm.model.line_levelling import Levelling, flattened, levelled
    from afspm.model.planned_work import PlannedWork
    from afspm.model.snapshot import from_plain, restored, snapshot, to_plain
    from afspm.night.notes import append_note
    from afspm.storage.atomic import OutageLog, replace_file, write_atomic
    from afspm.storage.formats import suffixes

if TYPE_CHECKING:  # a page's person and an agent measure and set as a script does
    from afspm.client.connect import GUEST, find_run, guest_of
    from afspm.client.cycle import Cycle, CycleOutcome
    from afspm.client.measurement import BEGUN_WITHIN_S
    from afspm.client.parameter_text import Value, from_parameter, to_parameter, value_in
    from afspm.client.targets import FITS, ScanTarget, SpectrumTarget, Target, is_set, target_from, xy_of

__all__ = [
    "Component",
    "ControlMode",
    "Events",
    "Memory",
    "Problem",
    "PublishedEvent",
    "Region",
    "Run",
    "Scan",
    "ScanSet",
    "Scope",
    "ScopeState",
    "Spectrum",
    "connect",
    "find_runs",
    "open_run",
    "read",
]
USERS_NAMES = tuple(__all__)
"""What `dir` lists, and the page of the Python API; the others are for plug-ins."""
__all__ += [
    "BEGUN_WITHIN_S",
    "FITS",
    "GUEST",
    "SD_PER_MAD",
    "Array",
    "ChannelPairing",
    "Cycle",
    "CycleOutcome",
    "HeightPair",
    "Levelling",
    "LineFile",
    "MissingChannels",
    "Opinion",
    "OutageLog",
    "PlannedWork",
    "Publication",
    "ScanTarget",
    "SpectrumTarget",
    "Target",
    "TipJudge",
    "Value",
    "append_note",
    "csv_line",
    "find_run",
    "flattened",
    "from_parameter",
    "from_plain",
    "guest_of",
    "is_set",
    "levelled",
    "replace_file",
    "restored",
    "robust_spread",
    "snapshot",
    "suffixes",
    "target_from",
    "tip_verdict",
    "to_parameter",
    "to_plain",
    "value_in",
    "write_atomic",
    "xy_of",
]

_own = lazily(
    __name__,
    {
        "afspm.basics.shared_time": "Publication",
        "afspm.client.component": "Component",
        "afspm.client.connect": "connect GUEST find_run guest_of",
        "afspm.client.cycle": "Cycle CycleOutcome",
        "afspm.client.events": "Events PublishedEvent",
        "afspm.client.measurement": "BEGUN_WITHIN_S",
        "afspm.client.parameter_text": "Value from_parameter to_parameter value_in",
        "afspm.client.scope": "Scope",
        "afspm.client.targets": "FITS ScanTarget SpectrumTarget Target is_set target_from xy_of",
        "afspm.components": "tip_verdict",
        "afspm.components.channel_pairs": "ChannelPairing HeightPair MissingChannels",
        "afspm.components.line_file": "LineFile csv_line",
        "afspm.components.tip_judge": "Opinion TipJudge",
        "afspm.model": "ControlMode Problem Region Scan ScanSet ScopeState Spectrum",
        "afspm.model.arrays": "SD_PER_MAD Array robust_spread",
        "afspm.model.line_levelling": "Levelling flattened levelled",
        "afspm.model.planned_work": "PlannedWork",
        "afspm.model.snapshot": "from_plain restored snapshot to_plain",
        "afspm.night.catalogue": "find_runs",
        "afspm.night.notes": "append_note",
        "afspm.night.run": "Run open_run",
        "afspm.storage.atomic": "OutageLog replace_file write_atomic",
        "afspm.storage.formats": "read suffixes",
        "afspm.storage.memory": "Memory",
    },
)


def __getattr__(name: str) -> Any:
    if name in __all__:
        return _own(name)
    # a function that a package adds, so that notebooks need no path of a guest; never under a name of Python's own, nor
    # of a module here: `from afspm import wire` asks for the name first, and must not read all packages' metadata
    if not name.startswith("_") and PathFinder.find_spec(f"{__name__}.{name}", __path__) is None:
        from afspm.basics import entry_points, packages

        if (found := entry_points.load(entry_points.FUNCTIONS, name)) is not None:
            return found
        if remedy := packages.advice(name):
            raise AttributeError(f"module 'afspm' has no attribute {name!r}: {remedy}")
    raise AttributeError(f"module 'afspm' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([name for name in globals() if name not in __all__] + list(USERS_NAMES))
