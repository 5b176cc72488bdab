"""The rows of the benchmark table: the measurements, and their targets.

A measurement is a function that yields rows, registered with `@measurement`; put it into a module of this package and
name the module in `__main__.MODULES`.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeVar


@dataclass(frozen=True)
class Row:
    """One line.

    Attributes:
        name: of the measured quantity.
        unit: of `ours` and `bare`.
        ours, bare: medians; `bare` is None without a comparison.
        ratio: ours over bare; without a comparison ours itself.
        target: for `ratio`.
        better: whether a low or a high ratio is better.
    """

    name: str
    unit: str
    ours: float
    bare: float | None
    target: float
    better: Literal["low", "high"] = "low"

    @property
    def ratio(self) -> float:
        return self.ours if self.bare is None else self.ours / self.bare

    @property
    def met(self) -> bool:
        return self.ratio <= self.target if self.better == "low" else self.ratio >= self.target

    def to_json(self) -> dict[str, object]:
        sign = "<=" if self.better == "low" else ">="
        return {
            "name": self.name,
            "unit": self.unit,
            "ours": self.ours,
            "bare": self.bare,
            "ratio": self.ratio,
            "target": f"{sign} {self.target:g}",
            "met": self.met,
        }


@dataclass(frozen=True)
class Failure:
    """A measurement that broke off.

    Attributes:
        name: of the measurement; rows yielded before are good.
        error: the exception's text.
    """

    name: str
    error: str

    def to_json(self) -> dict[str, object]:
        return {"name": self.name, "error": self.error, "met": False}


class NotMeasured(Exception):
    """A measurement lacks a program or package.

    Args:
        reason: the missing part.
        remedy: how to get the missing part; empty if there is no way.
    """

    def __init__(self, reason: str, remedy: str = "") -> None:
        super().__init__(f"{reason}; {remedy}" if remedy else reason)


@dataclass(frozen=True)
class Missing:
    """A measurement that can't be made on this computer.

    Attributes:
        name: of the measurement.
        reason: the missing part, and how to get it.
        rows: names of the rows that it yielded in the landed run.
    """

    name: str
    reason: str
    rows: tuple[str, ...] = ()

    def to_json(self) -> dict[str, object]:
        return {"name": self.name, "not_measured": self.reason, "rows": list(self.rows)}


Measurement = Callable[[], Iterator[Row]]
M = TypeVar("M", bound=Measurement)
MEASUREMENTS: dict[str, Measurement] = {}


def measurement(function: M, name: str = "") -> M:
    """Register a function that yields rows, under its name or another."""
    MEASUREMENTS[name or function.__name__] = function
    return function


def alternate(ours: Callable[[], float], bare: Callable[[], float], times: int) -> tuple[float, float]:
    """Return the medians of both, measured in turn, so that other load on the machine affects both alike."""
    pairs = [(ours(), bare()) if n % 2 else (bare(), ours())[::-1] for n in range(times)]
    return statistics.median(p[0] for p in pairs), statistics.median(p[1] for p in pairs)
