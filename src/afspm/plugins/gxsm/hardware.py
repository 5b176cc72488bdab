"""The hardware drivers ("HwI") of GXSM, which differ in names and in the meaning of status bits."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

from afspm.plugins.gxsm.errors import BadReply

STATUS: Final = "s"
ABORT: Final = "DSP_VP_ABORT_EXECUTE"
APPROACH: Final = "DSP_CMD_AUTOAPP"
AUTOSAVE: Final = {True: "CHECK-MainAutoSave", False: "UNCHECK-MainAutoSave"}
"""Actions that switch Auto Save on (True) and off (False)."""
REPEAT_OFF: Final = "UNCHECK-SCAN-REPEAT"
_MODES: Final = {"force": "FZ"}  # other kinds have GXSM's own names
_MOST_BITS: Final = 1 << 24  # larger and fractional numbers come from GXSM's uninitialised memory


class Hardware(Enum):
    """A kind of hardware driver."""

    SRANGER = "SRanger"
    RPSPMC = "RPSPMC"
    SIMULATOR = "simulator"


@dataclass(frozen=True)
class Offered:
    """The parameters and actions that a running GXSM lists, and the kind of its hardware."""

    refnames: frozenset[str]
    actions: frozenset[str]
    hardware: Hardware

    @property
    def kind(self) -> str:
        return self.hardware.value


@dataclass(frozen=True)
class Doing:
    """The state that GXSM reports.

    Attributes:
        scanning, probing: both True on RPSPMC during a scan or a spectrum, as this hardware has one bit for both.
        moving, approaching: always False on RPSPMC, which has no such bits.
    """

    feedback_on: bool
    scanning: bool
    probing: bool
    paused: bool
    moving: bool
    approaching: bool

    @property
    def measuring(self) -> bool:
        return self.scanning or self.probing


def recognised(refnames: Collection[str], actions: Collection[str]) -> Hardware:
    """Return the kind of hardware by the names that its driver adds to GXSM's lists; without any, SRanger."""
    if any(name.startswith("dsp-GVP-") for name in refnames) or any(name.startswith("GVP_CMD_") for name in actions):
        return Hardware.RPSPMC
    if any(name.startswith(("sim-", "template-")) for name in refnames):
        return Hardware.SIMULATOR
    return Hardware.SRANGER


def decoded(hardware: Hardware, slots: list[float]) -> Doing:
    """Decode the result of `rtquery("s")`; only the first of its three numbers is initialised.

    Raises:
        BadReply: the number is missing or not a set of bits.
    """
    value = slots[0] if slots else math.nan
    if not (0.0 <= value < _MOST_BITS and value == int(value)):
        raise BadReply(f"GXSM reports its state as {slots}, which is not a set of bits")
    bits = int(value)
    if hardware is Hardware.RPSPMC:
        running = bool(bits & 2)  # one bit for scan and spectrum
        return Doing(bool(bits & 1), running, running, bool(bits & 4), moving=False, approaching=False)
    return Doing(
        bool(bits & 1),
        bool(bits & 2),
        bool(bits & 8),
        bool(bits & 4),
        moving=bool(bits & 16),
        approaching=bool(bits & 128),
    )


def execute(kind: str) -> str:
    """Return the action that takes a spectrum of a kind."""
    return f"DSP_VP_{_MODES.get(kind, kind)}_EXECUTE"


def available(vendors: Mapping[str, str], refnames: Collection[str]) -> dict[str, str]:
    """Return the first available vendor's name of each parameter, by generic name.

    Parameters without an available name are left out.

    Args:
        vendors: alternative names by generic name, e.g. "dsp-fbs-bias | sim-stm-bias".
    """
    found = {}
    for name, vendor in vendors.items():
        there = [ref for ref in (one.strip() for one in vendor.split("|")) if ref in refnames]
        if there:
            found[name] = there[0]
    return found
