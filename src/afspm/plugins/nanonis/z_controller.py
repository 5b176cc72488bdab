"""The active z controller, compared at the start with the unit of the setpoint in the experiment file.

Nanonis reports the names of its z controllers, and which one is active, but no unit of the setpoint. The names of its
signals have their units: the controller "log Current" holds the signal "Current (A)". The mistake to find is the worst:
a setpoint of -20 Hz, sent to a controller that holds a current, is one of -20 A.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from typing import Final, cast

from afspm.basics import UnitError, convert
from afspm.plugins.nanonis.protocol import NanonisError, UnreadableReply

_ADDED: Final = {"log", "abs", "neg"}
"""Words in a z controller's name for what it makes of its signal."""
_SIGNAL: Final = re.compile(r"(.*)\(([^()]*)\)\s*")
_README: Final = "README of the driver, Setting it up"


def unit_of(controller: str, signals: Sequence[str]) -> str:
    """Return the unit of the signal that a z controller holds; empty if the names do not determine it.

    Args:
        signals: names with units, "Current (A)".
    """
    wanted = _words(controller) - _ADDED
    found: dict[tuple[bool, int], set[str]] = {}
    for name, unit in (match.groups() for match in map(_SIGNAL.fullmatch, signals) if match is not None):
        words = _words(name)
        if wanted and words and (words <= wanted or wanted <= words):
            found.setdefault((words == wanted, len(words & wanted)), set()).add(unit.strip())
    units = found[max(found)] if found else set()
    return units.pop() if len(units) == 1 else ""


def compare(ask: Callable[..., tuple[object, ...]], setpoint_unit: str, log: logging.Logger) -> None:
    """Warn if the active z controller holds a quantity with another unit than the setpoint's."""
    try:
        controllers, active = cast(tuple[list[str], int], ask("ZCtrl.CtrlListGet"))
        signals = cast(list[str], ask("Signals.NamesGet")[0])
    except (NanonisError, UnreadableReply) as error:
        log.warning("the active z controller is unknown: compare its unit with the setpoint's yourself: %s", error)
        return
    name = controllers[active] if 0 <= active < len(controllers) else ""
    unit = unit_of(name, signals)
    if not unit:
        text = "the unit of the active z controller %r is unknown: zctrl-setpoint is sent in %s (see %s)"
        log.warning(text, name, setpoint_unit or "no unit", _README)
    elif not _is_same(unit, setpoint_unit):
        text = (
            "the active z controller %r holds a value in %s, but zctrl-setpoint is in %s: each setpoint would be taken "
            "for one in %s. Choose the z controller at the panel, or set the unit in the experiment file (see %s)"
        )
        log.warning(text, name, unit, setpoint_unit or "no unit", unit, _README)
    else:
        log.info("the active z controller is %r, in %s", name, unit)


def _words(name: str) -> set[str]:
    return set(re.findall(r"[a-z0-9]+", name.casefold()))


def _is_same(unit: str, setpoint_unit: str) -> bool:
    # the same kind of unit is not enough: a value is sent as it is
    try:
        return bool(convert(1.0, unit, setpoint_unit) == 1.0)
    except UnitError:
        return False
