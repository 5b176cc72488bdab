"""The suite of translators."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from afspm.testing.conformance import Check, Suite

if TYPE_CHECKING:
    from afspm.testing.translators.measuring import CheckMeasurements

Checking = Callable[["CheckMeasurements"], None]
TRANSLATOR_SUITE: Final = Suite[Check](
    "afspm test-translator",
    f"{__package__}.checks",
    ("frames", "scans", "picture", "feedback", "probe", "spectra", "parameters", "refusals"),
)


def check(name: str, title: str, needs: tuple[str, ...] = ()) -> Callable[[Checking], Checking]:
    """Return a decorator that adds a check to the suite of translators."""

    def add(do: Checking) -> Checking:
        TRANSLATOR_SUITE.add(Check(name, title, do, needs))
        return do

    return add
