"""What a person does at the microscope itself, as a translator sees it, and the state of tip and feedback."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from afspm.basics.formatting import quantity
from afspm.model.caption import SettingInForce, caption, in_force
from afspm.model.requests import Parameter

if TYPE_CHECKING:
    from afspm.model.scan import Scan
    from afspm.model.spectrum import Spectrum

_DIGITS: Final = 7
"""As many as single precision has: many controllers keep their settings in it."""
_ALL_DIGITS: Final = 15
_ROUNDING: Final = 1e-12


class PanelAct(StrEnum):
    """An act at the microscope; the values are those on the wire."""

    STOP = "stop"
    """A measurement of the run was stopped."""
    PAUSE = "pause"
    """A scan of the run was paused; it goes on when it is resumed there."""
    SCAN = "scan"
    """A scan was begun."""
    SPECTRUM = "spectrum"
    WITHDRAW = "withdraw"
    """The tip was withdrawn or lifted."""
    FEEDBACK_OFF = "feedback-off"
    """The z feedback was switched off with the tip at the sample."""
    VALUES = "values"
    """Settings were changed."""
    CONTRADICTION = "contradiction"
    """Two results in a row were not what they stand for, for the same reason."""


_IN_WORDS = {
    PanelAct.STOP: "the measurement was stopped",
    PanelAct.PAUSE: "the scan was paused",
    PanelAct.SCAN: "a scan was begun",
    PanelAct.SPECTRUM: "a spectrum was begun",
    PanelAct.WITHDRAW: "the tip was withdrawn",
    PanelAct.FEEDBACK_OFF: "the z feedback was switched off",
    PanelAct.VALUES: "settings were changed",
    PanelAct.CONTRADICTION: "two measurements in a row are not what they stand for",
}


@dataclass(frozen=True, slots=True)
class ChangedValue:
    """A setting before and after a change, as texts in `unit`."""

    parameter: str
    before: str
    after: str
    unit: str = ""

    def __str__(self) -> str:
        before, after = (self._text(value, _DIGITS) for value in (self.before, self.after))
        if before == after:
            before, after = (self._text(value, _ALL_DIGITS) for value in (self.before, self.after))
        return f"{self.parameter} = {after} (before: {before})"

    def _text(self, value: str, digits: int) -> str:
        if (number := _number(value)) is None:
            return f"{value} {self.unit}".rstrip()
        # a corner at 0 is a difference of two lengths, which leaves their rounding: 3e-24 m
        largest = max(abs(_number(one) or 0.0) for one in (self.before, self.after))
        return quantity(0.0 if abs(number) < _ROUNDING * largest else number, self.unit, digits)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class ActByHand:
    """An act at the microscope that no request of the run has caused.

    Attributes:
        evidence: how the translator knows, in words.
        changes: of `PanelAct.VALUES`.
    """

    time_ns: int
    act: PanelAct
    evidence: str = ""
    changes: tuple[ChangedValue, ...] = ()

    def __str__(self) -> str:
        why = f" ({self.evidence})" if self.evidence else ""
        if self.act is PanelAct.VALUES:
            return f"set at the microscope: {', '.join(map(str, self.changes))}{why}"
        if self.act is PanelAct.CONTRADICTION:
            return f"{_IN_WORDS[self.act]}: {self.evidence}"
        return f"{_IN_WORDS[self.act]} at the microscope{why}"


@dataclass(frozen=True, slots=True)
class TipStatus:
    """The tip and its feedback, as the controller reports them.

    Attributes:
        engaged: whether the tip is at the sample; None: the controller does not report it.
        feedback_on: whether the z feedback is on; None: the controller does not report it.
        by_hand: what was done by hand, and keeps afspm from measuring, in words; empty: nothing.
    """

    engaged: bool | None = None
    feedback_on: bool | None = None
    by_hand: str = ""

    def __str__(self) -> str:
        tip = {True: "the tip is at the sample", False: "the tip is withdrawn", None: "the tip is not reported"}
        feedback = {
            True: "the z feedback is on",
            False: "the z feedback is off",
            None: "the z feedback is not reported",
        }
        return f"{tip[self.engaged]}, {feedback[self.feedback_on]}"

    @property
    def to_continue_with(self) -> str:
        """The state in words, for a person who lets the run continue and sees what the controller does not report."""
        return str(self) if self.engaged is not None else f"{self}: look whether the tip is at the sample"

    @property
    def remedy(self) -> str:
        """What a person has to do before anything is measured; empty: nothing."""
        if not self.by_hand:
            return ""
        if self.engaged is False:
            return "the tip is still withdrawn: approach at the panel"
        if self.feedback_on is False:
            return "the z feedback is still off: switch it on at the panel"
        return ""


@dataclass(frozen=True, slots=True)
class MeasurementConditions:
    """What a scan or spectrum stands for, and what was in force at its begin and at its end.

    Attributes:
        time_ns, filename: of the scan or spectrum.
        begin, end: the tip; None: not known, for example after a restart of the translator.
        acts: what was done by hand meanwhile.
        began_ns: None: not known.
        holder: the component whose request began it; empty: it was begun at the microscope, or that is not known.
        begin_values, end_values: the settings that the run has set for this measurement.
        unproved: what the controller could have shown of it and did not, in words.
        begin_in_force, end_in_force: the settings of its caption, set by the run or not.
    """

    time_ns: int
    filename: str
    begin: TipStatus | None = None
    end: TipStatus | None = None
    acts: tuple[ActByHand, ...] = ()
    began_ns: int | None = None
    holder: str = ""
    begin_values: tuple[Parameter, ...] = ()
    end_values: tuple[Parameter, ...] = ()
    unproved: tuple[str, ...] = ()
    begin_in_force: tuple[Parameter, ...] = ()
    end_in_force: tuple[Parameter, ...] = ()

    def is_of(self, result: Scan | Spectrum) -> bool:
        """Return whether they are published for a channel of a scan, or a spectrum."""
        return self.time_ns == result.time_ns or bool(result.filename and self.filename == result.filename)

    @property
    def in_force(self) -> tuple[SettingInForce, ...]:
        """The settings of its caption, also those of the run; these alone in records of an earlier version."""
        return in_force((*self.begin_values, *self.begin_in_force), (*self.end_values, *self.end_in_force))

    def caption(self) -> str:
        """Return the settings in force, "V = 100 mV, I = 20 pA, 5 nm/s"; empty if none is known."""
        return caption(self.in_force)
