"""The checks of clients, in order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afspm.testing.clients.bench import ClientBench

Judging = Callable[["ClientBench"], str | None]


@dataclass(frozen=True)
class ClientCheck:
    """One thing that a client has to do.

    Attributes:
        name: "requests/repeat": what it is about, and what.
        title: what holds, as a sentence.
        remedy: what to do if it does not.
        do: raises `Failed`; may return what is worth knowing though all is well.
    """

    name: str
    title: str
    remedy: str
    do: Judging


_CHECKS: list[ClientCheck] = []
_ORDER = ("wire", "launch", "replay", "requests", "measure", "control", "faults", "keys")
"""What the later ones need is checked by the earlier ones."""


def client_check(name: str, title: str, remedy: str) -> Callable[[Judging], Judging]:
    """Mark a function as a check."""

    def marked(do: Judging) -> Judging:
        _CHECKS.append(ClientCheck(name, title, remedy, do))
        return do

    return marked


def all_client_checks() -> tuple[ClientCheck, ...]:
    """Return all of them."""
    from afspm.testing.clients import checks  # noqa: F401  (importing them marks them)

    return tuple(sorted(_CHECKS, key=lambda one: _ORDER.index(one.name.partition("/")[0])))
