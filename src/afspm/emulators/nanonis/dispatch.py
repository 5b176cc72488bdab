"""Dispatch of the protocol's functions to their handlers in the modules `on_…`."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from afspm.emulators.nanonis.panel import NanonisState

Results = tuple[Any, ...]


class FunctionRefused(Exception):
    """The controller can't, and says why."""


@dataclass(frozen=True)
class DeferredResult:
    """The reply comes when something has happened.

    Attributes:
        ready: gives the results once it has.
        until_s: or at that time, experiment seconds, with `timed_out`.
        gave_up: called when that time has come first.
        next_s: when to look again, where nothing else tells.
    """

    ready: Callable[[float], Results | None]
    until_s: float = math.inf
    timed_out: Results = ()
    gave_up: Callable[[], None] = lambda: None
    next_s: Callable[[float], float] = lambda now_s: math.inf


Answer = Results | DeferredResult
Handler = Callable[..., Answer]
HANDLERS: Final[dict[str, Handler]] = {}
_NAMED: Final[set[Handler]] = set()
_STORED: Final = (
    "Bias", "BiasSpectr", "Current", "ZCtrl", "SafeTip", "AutoApproach", "ZSpectr", "Piezo", "Scan", "FolMe", "Pattern",
    "TipShaper", "Motor", "AtomTrack", "LockIn", "PLL", "Signals", "UserIn", "UserOut", "TCPLog", "Util",
)  # fmt: skip
"""The modules that are there: what is set in them is got again at least."""
_KEEPS_NAN: Final = ("BiasSpectr.PropsSet",)
_MAY_BE_INFINITE: Final = ("BiasSpectr.TimingSet", "ZSpectr.TimingSet")
"""A slew rate that is not limited is infinite."""


def answers(*names: str) -> Callable[[Handler], Handler]:
    """Marks what answers to these functions; a second argument `name` is told which it was."""

    def marked(handler: Handler) -> Handler:
        HANDLERS.update(dict.fromkeys(names, handler))
        if "name" in inspect.signature(handler).parameters:
            _NAMED.add(handler)
        return handler

    return marked


def answer(panel: NanonisState, name: str, arguments: list[Any]) -> Answer:
    """Execute a function and return its results.

    Raises:
        FunctionRefused, RigBusy, InvalidValue.
    """
    handler = HANDLERS.get(name)
    _refuse_no_numbers(name, arguments, keeps_nan=handler is None or name in _KEEPS_NAN)
    if handler is not None:
        return handler(panel, *([name] if handler in _NAMED else []), *arguments)
    if name.partition(".")[0] not in _STORED:
        raise FunctionRefused("Module not available")
    if name.endswith("Set"):
        try:
            panel.registers.set(name, arguments)
        except ValueError as error:
            raise FunctionRefused(str(error)) from error
        return ()
    if name.endswith("Get"):
        return panel.registers.got(name, arguments)
    raise FunctionRefused("it is not part of this emulator")


def _refuse_no_numbers(name: str, arguments: Iterable[Any], *, keeps_nan: bool) -> None:
    """The maker's own examples say of some functions that NaN is no change; (!) how others take it is not known."""
    for argument in arguments:
        if not isinstance(argument, str) and np.asarray(argument).dtype.kind == "f":
            values = np.asarray(argument)
            if (np.isnan(values).any() and not keeps_nan) or (np.isinf(values).any() and name not in _MAY_BE_INFINITE):
                raise FunctionRefused("a value is not a number")


def deadline_s(panel: NanonisState, timeout_ms: int) -> float:
    """Experiment time at which a client's patience ends, which is counted in real time."""
    return math.inf if timeout_ms < 0 else panel.clock.now_s() + panel.experiment_s(timeout_ms / 1000)


def chosen(number: int, *choices: Any) -> Any:
    """Return the choice of a number; choice 0 is usually "no change"."""
    if not 0 <= number < len(choices):
        raise FunctionRefused(f"{number} is none of the choices")
    return choices[number]


def until_free(panel: NanonisState, wait: int, timeout_ms: int = -1) -> Answer:
    """Return at once, or when the instrument is free if `wait` is set."""
    if not wait:
        return ()
    return DeferredResult(lambda now_s: None if panel.rig.busy(now_s) else (), deadline_s(panel, timeout_ms))
