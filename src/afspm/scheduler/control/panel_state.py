"""`PanelState`: what was done at the microscope by hand, and what follows from it for control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from afspm.basics.frozen import replace
from afspm.model import ActByHand, PanelAct, TipStatus


@dataclass(frozen=True)
class PanelState:
    """What a person did at the microscope, as far as it keeps the run from measuring.

    Attributes:
        tip: the tip and its feedback, as last published.
        why: the act that gave the microscope to a person, until the mode is AUTOMATED again; empty: none.
        outside: for each setting that was changed to a value outside the limits, the sentence that says so.
    """

    tip: TipStatus = field(default_factory=TipStatus)
    why: str = ""
    outside: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def with_change(self, parameter: str, refusal: str) -> PanelState:
        """Return the state after a change of a setting; `refusal` is empty for a value within the limits."""
        if not refusal and parameter not in self.outside:
            return self
        rest = {name: why for name, why in self.outside.items() if name != parameter}
        return replace(self, outside=MappingProxyType({**rest, parameter: refusal} if refusal else rest))

    @property
    def remedy(self) -> str:
        """What a person has to do before the run may measure again; empty: nothing."""
        if self.tip.remedy:
            return self.tip.remedy
        again = "set it back at the panel, and continue once more after a second, when it is read again"
        return "".join(f"{why}: {again}" for why in list(self.outside.values())[:1])

    def asks_for_pause(self, act: ActByHand, *, stopped: str, changed: str) -> bool:
        """Return whether an act gives the microscope to the person.

        Args:
            stopped, changed: the settings `stopped_by_hand` and `changed_by_hand`.
        """
        match act.act:
            case PanelAct.WITHDRAW | PanelAct.FEEDBACK_OFF | PanelAct.CONTRADICTION:
                return True
            case PanelAct.STOP:
                return stopped == "pause"
            case PanelAct.VALUES:
                return changed == "pause" or any(one.parameter in self.outside for one in act.changes)
            case _:
                return False
