"""Requests to Igor, by functions of Asylum's software and of `afspm.ipf`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from afspm.basics import Refused
from afspm.driver import Value
from afspm.model import ControlResponse, ScopeState
from afspm.plugins.asylum import xop
from afspm.plugins.asylum.link import Link, number, text

SCAN_STATUS, MAP_STATUS = "ScanStatus", "FMapStatus"

# Bits of ARGetStatus: only the published afspm documents them, so a second source decides, too (see `Doing.state`).
_SCANNING, _ENGAGED, _FORCE, _MOTOR = 0x1, 0x2, 0xF0, 0x100000
_LONGEST_LIST: Final = 800
"""Characters of names in one request, which has at most 1024 bytes."""


@dataclass(frozen=True)
class Doing:
    """The state that the controller reports.

    Attributes:
        bits: result of ARGetStatus; None if this release of Asylum's software lacks the function.
        scanning, mapping: the values behind Asylum's panels, ScanStatus and FMapStatus.
    """

    bits: int | None
    scanning: bool
    mapping: bool

    @property
    def state(self) -> ScopeState:
        """Return the state from both sources; a measurement reported by either source counts as running."""
        bits = self.bits or 0
        if self.mapping or bits & _FORCE:
            return ScopeState.SPEC
        if self.scanning or bits & _SCANNING:
            return ScopeState.SCANNING
        return ScopeState.COARSE_MOTOR if bits & _MOTOR else ScopeState.FREE

    @property
    def engaged(self) -> bool:
        """True if the tip is at the sample, or if its place is unknown for lack of ARGetStatus."""
        return self.bits is None or bool(self.bits & (_ENGAGED | _SCANNING)) or self.scanning


class Session:
    """A connection to Igor, and the features of the installation.

    Args:
        link: the open connection.

    Attributes:
        at_once: True until a request shows that Igor lacks `afspm.ipf`, which returns many values with one request.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self.at_once = True

    def ask(self, name: str, *parameters: xop.Parameter) -> xop.Result:
        return self._link.ask(name, *parameters)

    def number(self, name: str, *parameters: xop.Parameter) -> float:
        return number(self.ask(name, *parameters))

    def text(self, name: str, *parameters: xop.Parameter) -> str:
        return text(self.ask(name, *parameters))

    def do(self, name: str, *parameters: xop.Parameter) -> bool:
        """Call a function for its effect; return False if it reports a refusal.

        Asylum's functions return 1 for a refusal, except DoForceFunc: a refused curve returns 0 and shows only in the
        state. Functions without a result return NaN, which has no meaning.
        """
        return self.ask(name, *parameters) != 1.0

    def close(self) -> None:
        self._link.close()

    def feedback_on(self) -> bool:
        """Return True if the z feedback is on; without `afspm.ipf`, if the tip is at the sample."""
        return bool(self.number("AfspmFeedbackOn")) if self.at_once else self.doing().engaged

    def controller(self) -> str:
        """Return the controller's name and version."""
        return f"Asylum Research, {self.text('AfspmController')}" if self.at_once else "Asylum Research"

    # --- values ---

    def doing(self) -> Doing:
        bits, values = self._look((SCAN_STATUS, MAP_STATUS))
        scanning, mapping = (bool(value) and not math.isnan(value) for value in values)
        return Doing(None if math.isnan(bits) else int(bits), scanning, mapping)

    def values(self, names: Sequence[str]) -> dict[str, float]:
        """Return Asylum's numbers by name.

        Raises:
            Refused: PARAM_NOT_SUPPORTED: Asylum has no number of this name in its present mode.
        """
        found = dict(zip(names, self._look(names)[1], strict=True))
        for name, value in found.items():
            if math.isnan(value):
                reason = f"Asylum has no value {name!r} in its present mode (GV returns nan)"
                raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, reason)
        return found

    # PV checks no range, and updates none of the values that the panel derives.
    def put(self, values: Mapping[str, Value]) -> None:
        for name, value in values.items():
            if isinstance(value, str):
                self.ask("PS", name, value)
            else:
                self.ask("PV", name, float(value))

    def _look(self, names: Sequence[str]) -> tuple[float, list[float]]:
        # Without `afspm.ipf`, each value is one request. Its absence is remembered: each attempt would cost a request.
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
        reply = self.text("AfspmLook", "".join(f"{name};" for name in names))
        try:
            found = [float(word) for word in reply.removesuffix(";").split(";")]
        except ValueError as error:
            raise xop.BadReply(f"AfspmLook returned {reply!r}") from error
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
    # ZeroMQ-XOP drops the connection at requests of more than 1024 bytes.
    parts: list[list[str]] = [[]]
    for name in names:
        if sum(len(one) + 1 for one in parts[-1]) + len(name) > _LONGEST_LIST:
            parts.append([])
        parts[-1].append(name)
    return parts
