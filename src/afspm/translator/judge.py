"""`judge`: whether a result is what it stands for. Pure, and the same for all makers.

| | is | comes from |
| --- | --- | --- |
| claim | what it stands for: who asked for it, the run's settings for it, the tip | its begin, kept on disk |
| witness | what the controller shows at its end | the driver |
| stated | what the files say of themselves | the reader of the maker's files |
| verdict | a contradiction, or the facts left unproved | `judge` |

A contradicted result is not complete. An unproved one is published, and says what its maker could have shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import area_text, position_text
from afspm.model import Region, TipStatus, names
from afspm.translator.parameters import FEEDBACK_ON, Value
from afspm.translator.setting_groups import FRAME, as_list, as_region

RESOLUTION_NS: Final = 2 * NS_PER_S
"""Of times in files, which have whole seconds, with a margin."""
_PART: Final = 1e-3
"""Of the frame's larger side, and in rad: a reader gives the set frame for one that is equal within a file's digits."""
SETTINGS: Final = (
    names.ZCTRL_SETPOINT,
    names.ZCTRL_PGAIN,
    names.ZCTRL_IGAIN,
    names.TIP_BIAS_VOLTAGE,
    names.SCAN_SPEED,
)
WITNESSES: Final[Mapping[str, Sequence[str]]] = {
    "tip at the sample": (names.ENGAGED,),
    "feedback on": (FEEDBACK_ON,),
    "settings in force": SETTINGS,
    "frame in force": FRAME,
    "which measurement it is": (),
    "another one begun": (),
    "start in the file": (),
    "end in the file": (),
    "frame in the file": (),
    "missing rows": (),
    "one start in all channels": (),
    "stop of a scan": (),
    "stop of a spectrum": (),
}
"""What proves a result, with the parameters that show it; without any, the driver says what its controller lacks."""


@dataclass(frozen=True)
class Claim:
    """What a measurement stands for.

    Attributes:
        began_ns: when its start was published.
        holder: the component that asked for it; empty: it was begun at the microscope.
        tip: at its begin; None: not read.
        values: the settings that the run has set for it, as read back then, in SI.
        begin: the same settings at its begin.
        in_force: the settings of its caption at its begin, whether or not the run has set them; None: not known.
        frame, shape: of a scan, right before it was asked for; None: not known.
    """

    began_ns: int
    holder: str = ""
    tip: TipStatus | None = None
    values: Mapping[str, Value] = field(default_factory=dict)
    begin: Mapping[str, Value] = field(default_factory=dict)
    frame: Region | None = None
    shape: tuple[int, int] | None = None
    in_force: Mapping[str, Value | None] = field(default_factory=dict)

    def kept(self) -> dict[str, Any]:
        tip = None if self.tip is None else [self.tip.engaged, self.tip.feedback_on]
        return {
            "began_ns": self.began_ns,
            "holder": self.holder,
            "tip": tip,
            "values": dict(self.values),
            "begin": dict(self.begin),
            "frame": None if self.frame is None else as_list(self.frame),
            "shape": self.shape,
            "in_force": dict(self.in_force),
        }

    @classmethod
    def of(cls, kept: Mapping[str, Any]) -> Claim:
        tip = None if kept["tip"] is None else TipStatus(*kept["tip"])
        claim = cls(kept["began_ns"], kept["holder"], tip, kept["values"], kept["begin"])
        claim = replace(claim, in_force=kept.get("in_force", {}))
        if kept.get("frame") is None:  # a process of an earlier version kept none
            return claim
        rows, columns = kept["shape"]
        return replace(claim, frame=as_region(kept["frame"]), shape=(rows, columns))


@dataclass(frozen=True)
class Stated:
    """What the files of a result say of their measurement, as far as their maker writes it.

    Attributes:
        began_ns, ended_ns: start and end by each file, in the clock of the files.
        earlier: the starts of earlier results in the same clock, each with the end of its measurement in ours.
        frame, shape: of a scan; None: not known.
        disturbed: what was done to the measurement while it ran, in words; empty: nothing.
        pictures: the largest number of pictures of one channel.
        at_most_ns: the longest duration of the measurement by our clock; None: it can't be compared with the files.
        unproved: what these files could have shown and do not, in words.
    """

    began_ns: tuple[int, ...] = ()
    ended_ns: tuple[int, ...] = ()
    earlier: Mapping[int, int] = field(default_factory=dict)
    frame: Region | None = None
    shape: tuple[int, int] | None = None
    disturbed: str = ""
    pictures: int = 1
    at_most_ns: int | None = None
    unproved: tuple[str, ...] = ()


@dataclass(frozen=True)
class ResultVerdict:
    """The verdict on a result.

    Attributes:
        rule: the name of the rule that contradicts it; empty: none does.
        sentence: why it is not what it stands for.
        unproved: what its maker could have shown, and did not.
    """

    rule: str = ""
    sentence: str = ""
    unproved: tuple[str, ...] = ()


@dataclass(frozen=True)
class Witness:
    """What the controller shows at the end of a measurement.

    Attributes:
        tip: None: not read.
        differs: for each setting of the claim that was not in force at begin or end, the sentence that says so.
    """

    tip: TipStatus | None = None
    differs: Mapping[str, str] = field(default_factory=dict)


def judge(claim: Claim, witness: Witness, stated: Stated) -> ResultVerdict:
    """Return the verdict on a result: the first rule that contradicts it."""
    for name, rule in RULES.items():
        if sentence := rule(claim, witness, stated):
            return ResultVerdict(name, sentence, stated.unproved)
    return ResultVerdict(unproved=stated.unproved)


def _one_start(claim: Claim, witness: Witness, stated: Stated) -> str:
    off_ns = max(stated.began_ns, default=0) - min(stated.began_ns, default=0)
    if off_ns <= RESOLUTION_NS:
        return ""
    return f"its channels state starts {off_ns / NS_PER_S:.0f} s apart: a part of it is of another measurement"


def _new_start(claim: Claim, witness: Witness, stated: Stated) -> str:
    # two short measurements may have begun in one second
    ends_ns = [stated.earlier[one] for one in stated.began_ns if one in stated.earlier]
    is_old = any(claim.began_ns - one > RESOLUTION_NS for one in ends_ns)
    return "its file states the start of an earlier measurement" if is_old else ""


def _end_after_start(claim: Claim, witness: Witness, stated: Stated) -> str:
    is_half = bool(stated.began_ns) and any(one < max(stated.began_ns) for one in stated.ended_ns)
    return "its file was saved before the measurement had ended" if is_half else ""


def _one_picture(claim: Claim, witness: Witness, stated: Stated) -> str:
    if stated.pictures <= 1:
        return ""
    return f"its file has {stated.pictures} pictures of a channel: only one is of this measurement"


def _own_start(claim: Claim, witness: Witness, stated: Stated) -> str:
    if stated.at_most_ns is None or not (stated.began_ns and stated.ended_ns):
        return ""
    off_ns = max(stated.ended_ns) - min(stated.began_ns) - stated.at_most_ns
    if off_ns <= RESOLUTION_NS:
        return ""
    return f"its file states a start {off_ns / NS_PER_S:.0f} s before it could have begun: it is of another measurement"


def _undisturbed(claim: Claim, witness: Witness, stated: Stated) -> str:
    return stated.disturbed


def _own_frame(claim: Claim, witness: Witness, stated: Stated) -> str:
    if claim.frame is None or stated.frame is None:
        return ""
    if claim.shape and stated.shape and claim.shape != stated.shape:
        rows, columns = stated.shape
        return (
            f"it has {columns} x {rows} pixels, and {claim.shape[1]} x {claim.shape[0]} were set when it was asked for"
        )
    asked, had, slack_m = claim.frame, stated.frame, _PART * max(claim.frame.size_m)
    sides = zip((*asked.center_m, *asked.size_m), (*had.center_m, *had.size_m), strict=True)
    turn_rad = math.remainder(asked.angle_rad - had.angle_rad, math.tau)
    if all(abs(a - b) <= slack_m for a, b in sides) and abs(turn_rad) <= _PART:
        return ""
    return f"its frame is {_frame_text(had)}, and {_frame_text(asked)} was set when it was asked for"


def _frame_text(frame: Region) -> str:
    turned = f" at {math.degrees(frame.angle_rad):.5g}°" if frame.angle_rad else ""
    return f"{area_text(frame.size_m)} around {position_text(frame.center_m)}{turned}"


def _tip_at_sample(claim: Claim, witness: Witness, stated: Stated) -> str:
    was, is_now = claim.tip, witness.tip
    withdrawn = was is not None and is_now is not None and was.engaged is True and is_now.engaged is False
    return "the tip was at the sample at its begin, and is withdrawn at its end" if withdrawn else ""


def _values_in_force(claim: Claim, witness: Witness, stated: Stated) -> str:
    return "; ".join(witness.differs.values())


RULES: Mapping[str, Callable[[Claim, Witness, Stated], str]] = {
    "undisturbed": _undisturbed,
    "one picture": _one_picture,
    "one start": _one_start,
    "new start": _new_start,
    "end after start": _end_after_start,
    "own start": _own_start,
    "own frame": _own_frame,
    "tip at the sample": _tip_at_sample,
    "values in force": _values_in_force,
}
"""Each rule returns why a result is not what it stands for; empty: it does not say so."""
