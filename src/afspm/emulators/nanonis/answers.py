"""How the functions of the protocol are answered; what each does stands in the modules `on_…`."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from afspm.emulators.nanonis.panel import Panel

Results = tuple[Any, ...]


class Nope(Exception):
    """The controller can't, and says why."""


@dataclass(frozen=True)
class Later:
    """The reply comes when something has happened.

    Attributes:
        ready: gives the results once it has.
        until_s: or at that time, experiment seconds, with `timed_out`.
    """

    ready: Callable[[float], Results | None]
    until_s: float = math.inf
    timed_out: Results = ()


Answer = Results | Later
Handler = Callable[..., Answer]
HANDLERS: Final[dict[str, Handler]] = {}
_NAMED: Final[set[Handler]] = set()
REGISTERS_AT_FIRST: Final[dict[str, Results]] = {
    "ZCtrl.SwitchOffDelay": (0.05,),
    "ZCtrl.ZPos": (0.0,),
    "BiasSpectr.Timing": (0.05, 0.0, 0.005, math.inf, 0.002, 0.001, 0.005, 0.2),
    "BiasSpectr.AdvProps": (1, 1, 0, 0),
    "ZSpectr.Range": (0.0, 120e-9),
    "Bias.Calibr": (1.0, 0.0),
    "Piezo.Sens": (3.8e-9, 3.8e-9, 0.9e-9),
    "TipShaper.Props": (0.1, 0, 0.0, -1e-9, 0.1, 0.0, 0.1, 1e-9, 0.1, 0.1, 1),
    "Util.RTFreq": (20e3,),
    "Util.AcqPeriod": (0.02,),
    "Util.RTOversampl": (10,),
    "FolMe.Oversampl": (10, 0.01),
    "SafeTip.Props": (0, 1, 1e-9),
}


def answers(*names: str) -> Callable[[Handler], Handler]:
    """Marks what answers to these functions; a second argument `name` is told which it was."""

    def marked(handler: Handler) -> Handler:
        HANDLERS.update(dict.fromkeys(names, handler))
        if "name" in inspect.signature(handler).parameters:
            _NAMED.add(handler)
        return handler

    return marked


def answer(panel: Panel, name: str, arguments: list[Any], zeros: Results) -> Answer:
    """What is done and replied.

    Args:
        zeros: results where nothing else is known.

    Raises:
        Nope, RigBusy.
    """
    handler = HANDLERS.get(name)
    if handler is not None:
        return handler(panel, *([name] if handler in _NAMED else []), *arguments)
    register = name.removesuffix("Set").removesuffix("Get")
    if name.endswith("Set"):
        panel.registers[register] = tuple(arguments)
        return ()
    if name.endswith("Get"):
        at_first = REGISTERS_AT_FIRST.get(register, zeros)
        kept = panel.registers.get(register, ())
        return (*kept, *at_first[len(kept) :])  # some tell more than can be set
    return zeros


def deadline_s(panel: Panel, timeout_ms: int) -> float:
    return math.inf if timeout_ms < 0 else panel.clock.now_s() + timeout_ms / 1000


def chosen(number: int, *choices: Any) -> Any:
    """What a number stands for; as a rule 0 is what it is already."""
    if not 0 <= number < len(choices):
        raise Nope(f"{number} is none of the choices")
    return choices[number]


def until_free(panel: Panel, wait: int, timeout_ms: int = -1) -> Answer:
    """At once, or once the instrument has done what it was told."""
    if not wait:
        return ()
    return Later(lambda now_s: None if panel.rig.busy(now_s) else (), deadline_s(panel, timeout_ms))
