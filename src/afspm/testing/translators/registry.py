"""The checks there are, in the order in which they are done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afspm.testing.translators.taking import Taking


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
    do: Callable[[Taking], None]
    needs: tuple[str, ...] = ()


_CHECKS: list[Check] = []


def check(
    name: str, title: str, needs: tuple[str, ...] = ()
) -> Callable[[Callable[[Taking], None]], Callable[[Taking], None]]:
    """Marks a function as a check; they are done in the order in which they are marked."""

    def marked(do: Callable[[Taking], None]) -> Callable[[Taking], None]:
        _CHECKS.append(Check(name, title, do, needs))
        return do

    return marked


def all_checks() -> tuple[Check, ...]:
    """All of them."""
    from afspm.testing.translators import checks  # noqa: F401  (importing them marks them)

    return tuple(_CHECKS)
