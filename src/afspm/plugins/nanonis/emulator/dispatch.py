"""Dispatch of the protocol's functions to handlers: methods of the software's modules marked by `answers`."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar

import numpy as np

from afspm.plugins.nanonis.emulator.as_reported import NO_MODULE
from afspm.plugins.nanonis.emulator.registers import Registers

T = TypeVar("T")
Results = tuple[object, ...]
_STORED: Final = (
    "Bias", "BiasSpectr", "Current", "ZCtrl", "SafeTip", "AutoApproach", "ZSpectr", "Piezo", "Scan", "FolMe", "Pattern",
    "TipShaper", "Motor", "AtomTrack", "LockIn", "PLL", "Signals", "UserIn", "UserOut", "TCPLog", "Util", "File",
)  # fmt: skip
"""Modules of the real software, whose functions without a handler store values in registers."""
_KEEPS_NAN: Final = ("BiasSpectr.PropsSet", "ZSpectr.RangeSet")
_MAY_BE_INFINITE: Final = ("BiasSpectr.TimingSet", "ZSpectr.TimingSet")
"""Infinite slew rates mean no limit."""


class FunctionRefused(Exception):
    """The refusal of a function by the controller, with a reason."""


class OtherLayout(tuple[object, ...]):
    """Results that are sent in another layout than documented."""


class OldLayout(tuple[object, ...]):
    """Results that are sent as the oldest release sends them."""


class NoResult(tuple[object, ...]):
    """Results that are left out."""


@dataclass(frozen=True)
class DeferredResult:
    """A result that waits for an event.

    Attributes:
        ready: returns the results after the event, None before.
        until_s: deadline in experiment seconds, with `timed_out` as the results.
        gave_up: called when the deadline passes first.
        next_s: returns the time of the next check, if no event triggers a check before.
    """

    ready: Callable[[float], Results | None]
    until_s: float = math.inf
    timed_out: Results = ()
    gave_up: Callable[[], None] = lambda: None
    next_s: Callable[[float], float] = lambda now_s: math.inf


Answer = Results | DeferredResult
Handler = Callable[..., Answer]


def answers(*names: str) -> Callable[[Handler], Handler]:
    """Mark a method as the handler of functions. An optional parameter `name` receives the function's name."""

    def marked(handler: Handler) -> Handler:
        handler.answered_functions = names  # type: ignore[attr-defined]
        return handler

    return marked


class Dispatcher:
    """The handlers of all modules; registers store the values of settings without a handler."""

    def __init__(self, registers: Registers, modules: Iterable[object]) -> None:
        self._registers = registers
        self._handlers: dict[str, Handler] = {}
        self._removed: tuple[str, ...] = ()
        self._closed: tuple[str, ...] = ()
        for module in modules:
            for attribute, marked in vars(type(module)).items():
                for name in getattr(marked, "answered_functions", ()):
                    self._handlers[name] = _bound(getattr(module, attribute), name)

    def remove(self, *modules: str) -> None:
        """Refuse all functions of some modules ("Piezo."), as software without a licence for them does."""
        self._removed = modules

    def close(self, *modules: str) -> None:
        """Refuse all functions of some modules, as if their windows were closed."""
        self._closed = modules

    def call(self, name: str, arguments: list[object]) -> Answer:
        """Execute a function; return its results.

        Raises:
            FunctionRefused: no such module or function, or a value is not allowed. InstrumentBusy, InvalidValue: errors
                of the handler.
        """
        if name.startswith(self._removed):
            raise FunctionRefused("Module not available")
        if (module := name.partition(".")[0]) in self._closed:
            raise FunctionRefused(NO_MODULE.format(module=module))
        handler = self._handlers.get(name)
        _refuse_nan(name, arguments, keeps_nan=handler is None or name in _KEEPS_NAN)
        if handler is not None:
            return handler(*arguments)
        if name.partition(".")[0] not in _STORED:
            raise FunctionRefused("Module not available")
        if name.endswith("Get"):
            return self._registers.got(name, arguments)
        if not name.endswith("Set"):
            raise FunctionRefused("it is not part of this emulator")
        try:
            self._registers.set(name, arguments)
        except ValueError as error:
            raise FunctionRefused(str(error)) from error
        return ()


def _bound(handler: Handler, name: str) -> Handler:
    return partial(handler, name) if "name" in inspect.signature(handler).parameters else handler


def chosen(number: int, *choices: T) -> T:
    """Return the choice with this number. Raises FunctionRefused: there is no such choice.

    In most functions 0 means no change: the first choice is then the present value.
    """
    if not 0 <= number < len(choices):
        raise FunctionRefused(f"{number} is none of the choices")
    return choices[number]


def _refuse_nan(name: str, arguments: Iterable[object], *, keeps_nan: bool) -> None:
    # NaN means no change in the maker's own examples of some functions (! nan-no-change)
    for argument in arguments:
        if not isinstance(argument, str) and np.asarray(argument).dtype.kind == "f":
            values = np.asarray(argument)
            if (np.isnan(values).any() and not keeps_nan) or (np.isinf(values).any() and name not in _MAY_BE_INFINITE):
                raise FunctionRefused("a value is not a number")
