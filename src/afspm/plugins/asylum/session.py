"""Questions to Igor, by the functions of Asylum's software and of `afspm.ipf`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from afspm.basics.errors import Refused
from afspm.model import ControlResponse, ScopeState
from afspm.plugins.asylum import xop
from afspm.plugins.asylum.link import Link, number, text
from afspm.translator.parameters import Value

SCAN_STATUS, MAP_STATUS = "ScanStatus", "FMapStatus"

_SCANNING, _ENGAGED, _FORCE, _MOTOR = 0x1, 0x2, 0xF0, 0x100000
_LONGEST_LIST: Final = 800
"""Characters: a longer one would not fit into a request."""


@dataclass(frozen=True)
class Doing:
    """The state that the controller tells of itself.

    Attributes:
        bits: of ARGetStatus; None where that is not there.
        scanning, mapping: of the values that Asylum's panels go by.
    """

    bits: int | None
    scanning: bool
    mapping: bool

    @property
    def state(self) -> ScopeState:
        """Both sources count: what one of them says to be running, is."""
        bits = self.bits or 0
        if self.mapping or bits & _FORCE:
            return ScopeState.SPEC
        if self.scanning or bits & _SCANNING:
            return ScopeState.SCANNING
        return ScopeState.COARSE_MOTOR if bits & _MOTOR else ScopeState.FREE

    @property
    def engaged(self) -> bool:
        """True if the tip is at the sample; where that can't be known it is to be taken care of as if it were."""
        return self.bits is None or bool(self.bits & (_ENGAGED | _SCANNING)) or self.scanning


class Session:
    """One connection, and what was found out about who is there.

    Args:
        link: connected.

    Attributes:
        at_once: whether there is `afspm.ipf`: many values can then be had by one request.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self.at_once = True

    def ask(self, name: str, *parameters: xop.Parameter) -> xop.Result:
        """Call any function with one result."""
        return self._link.ask(name, *parameters)

    def number(self, name: str, *parameters: xop.Parameter) -> float:
        """Call a function that gives a number."""
        return number(self.ask(name, *parameters))

    def text(self, name: str, *parameters: xop.Parameter) -> str:
        """Call a function that gives a text."""
        return text(self.ask(name, *parameters))

    def do(self, name: str, *parameters: xop.Parameter) -> bool:
        """Call a function that does something: whether it did not say that it refuses.

        Asylum's own give 1 for a refusal. Others end without a result, which arrives as NaN and says nothing.
        """
        return self.ask(name, *parameters) != 1.0

    def close(self) -> None:
        """End the connection."""
        self._link.close()

    def feedback_on(self) -> bool:
        """Return True if the z feedback runs; where Igor can't be asked, if the tip is at the sample."""
        return bool(self.number("AfspmFeedbackOn")) if self.at_once else self.doing().engaged

    def controller(self) -> str:
        """Return what it calls itself."""
        return f"Asylum Research, {self.text('AfspmController')}" if self.at_once else "Asylum Research"

    # --- values ---

    def doing(self) -> Doing:
        """Return what the controller does now."""
        bits, values = self._look((SCAN_STATUS, MAP_STATUS))
        scanning, mapping = (bool(value) and not math.isnan(value) for value in values)
        return Doing(None if math.isnan(bits) else int(bits), scanning, mapping)

    def values(self, names: Sequence[str]) -> dict[str, float]:
        """Numbers of Asylum's by their names.

        Raises:
            Refused: PARAM_NOT_SUPPORTED: it has none of that name.
        """
        found = dict(zip(names, self._look(names)[1], strict=True))
        for name, value in found.items():
            if math.isnan(value):
                reason = f"Asylum has no value {name!r} in its present mode (GV returns nan)"
                raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, reason)
        return found

    def put(self, name: str, value: Value) -> None:
        """Set a number or a text of Asylum's."""
        if isinstance(value, str):
            self.ask("PS", name, value)
        else:
            self.ask("PV", name, float(value))

    def _look(self, names: Sequence[str]) -> tuple[float, list[float]]:
        """The bits of ARGetStatus (NaN where that is not there), and values."""
        if self.at_once:
            try:
                bits, values = math.nan, list[float]()
                for part in _parts(names):
                    bits, *some = self._several(part)
                    values += some
                return bits, values
            except xop.XopError as error:
                if error.number != xop.MISSING:
                    raise
                self.at_once = False
        return self._bits(), [self.number("GV", name) for name in names]

    def _several(self, names: Sequence[str]) -> list[float]:
        told = self.text("AfspmLook", "".join(f"{name};" for name in names))
        try:
            found = [float(word) for word in told.removesuffix(";").split(";")]
        except ValueError as error:
            raise xop.BadReply(f"AfspmLook returned {told!r}") from error
        if len(found) != 1 + len(names):
            raise xop.BadReply(f"AfspmLook returned {len(found) - 1} values instead of {len(names)}")
        return found

    def _bits(self) -> float:
        try:
            return self.number("ARGetStatus")
        except xop.XopError as error:
            if error.number != xop.MISSING:
                raise
            return math.nan


def _parts(names: Sequence[str]) -> list[list[str]]:
    """The names in lists that fit into a request each."""
    parts: list[list[str]] = [[]]
    for name in names:
        if sum(len(one) + 1 for one in parts[-1]) + len(name) > _LONGEST_LIST:
            parts.append([])
        parts[-1].append(name)
    return parts
