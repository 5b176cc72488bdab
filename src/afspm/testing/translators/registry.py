"""The checks, in order, and their verdicts: nothing, or what was expected and what came, in one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afspm.testing.translators.measuring import CheckMeasurements


@dataclass(frozen=True)
class Check:
    """One thing that a translator has to do.

    Attributes:
        name: "scan/cancel": what it is about, and what.
        title: what is right, as a sentence.
        do: raises `Failed` or `Skipped`.
        needs: actions and parameters without which there is nothing to check.
    """

    name: str
    title: str
    do: Callable[[CheckMeasurements], None]
    needs: tuple[str, ...] = ()


_CHECKS: list[Check] = []


def check(
    name: str, title: str, needs: tuple[str, ...] = ()
) -> Callable[[Callable[[CheckMeasurements], None]], Callable[[CheckMeasurements], None]]:
    """Marks a function as a check; they are done in the order in which they are marked."""

    def marked(do: Callable[[CheckMeasurements], None]) -> Callable[[CheckMeasurements], None]:
        _CHECKS.append(Check(name, title, do, needs))
        return do

    return marked


def all_checks() -> tuple[Check, ...]:
    """All of them."""
    from afspm.testing.translators import checks  # noqa: F401  (importing them marks them)

    return tuple(_CHECKS)
