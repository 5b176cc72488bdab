"""Ready-made components: scan plans, surveys, tip judge and repair, notes, notifications, the recorder.

Each is an ordinary component: it derives from `afspm.Component`, is named by an entry point, and could be yours.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.basics.shared_time import Publication
    from afspm.components.channel_pairs import ChannelPairing, HeightPair, MissingChannels
    from afspm.components.line_file import LineFile, csv_line
    from afspm.components.tip_judge import Opinion, TipJudge
    from afspm.model.arrays import SD_PER_MAD, Array, robust_spread
    from afspm.model.curve_request import CurveTable, curve_parameters
    from afspm.model.line_levelling import Levelling, flattened, levelled
    from afspm.model.planned_work import PlannedWork
    from afspm.model.snapshot import from_plain, restored, snapshot, to_plain
    from afspm.night.notes import append_note
    from afspm.storage.atomic import OutageLog, replace_file, write_atomic
    from afspm.storage.formats import suffixes

__all__ = [
    "SD_PER_MAD",
    "Array",
    "ChannelPairing",
    "CurveTable",
    "HeightPair",
    "Levelling",
    "LineFile",
    "MissingChannels",
    "Opinion",
    "OutageLog",
    "PlannedWork",
    "Publication",
    "TipJudge",
    "append_note",
    "csv_line",
    "curve_parameters",
    "flattened",
    "from_plain",
    "levelled",
    "replace_file",
    "restored",
    "robust_spread",
    "snapshot",
    "suffixes",
    "to_plain",
    "write_atomic",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.basics.shared_time": "Publication",
            "afspm.components.channel_pairs": "ChannelPairing HeightPair MissingChannels",
            "afspm.components.line_file": "LineFile csv_line",
            "afspm.components.tip_judge": "Opinion TipJudge",
            "afspm.model.arrays": "SD_PER_MAD Array robust_spread",
            "afspm.model.curve_request": "CurveTable curve_parameters",
            "afspm.model.line_levelling": "Levelling flattened levelled",
            "afspm.model.planned_work": "PlannedWork",
            "afspm.model.snapshot": "from_plain restored snapshot to_plain",
            "afspm.night.notes": "append_note",
            "afspm.storage.atomic": "OutageLog replace_file write_atomic",
            "afspm.storage.formats": "suffixes",
        },
    )
