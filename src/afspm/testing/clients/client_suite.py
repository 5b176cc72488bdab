"""The suite of clients."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from afspm.testing.conformance import Check, Suite

if TYPE_CHECKING:
    from afspm.testing.clients.bench import ClientBench

Judging = Callable[["ClientBench"], str | None]
CLIENT_SUITE: Final = Suite[Check](
    "afspm test-client",
    f"{__package__}.checks",
    # in this order, since checks rely on earlier ones
    ("wire", "launch", "replay", "requests", "measure", "control", "keys"),
)


def client_check(name: str, title: str, remedy: str) -> Callable[[Judging], Judging]:
    """Return a decorator that adds a check to the suite of clients."""

    def add(do: Judging) -> Judging:
        CLIENT_SUITE.add(Check(name, title, do, remedy=remedy))
        return do

    return add
