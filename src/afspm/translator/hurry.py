"""Waits for an answer that end early for the sake of a withdrawal of the tip over another connection.

A translator asks one question at a time, and a request to withdraw the tip must not wait behind a question to a port
that stays silent. The translator registers a test for its own thread; other threads of a driver are never hurried.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from afspm.translator.driver_base import ControllerLost

SILENT_S: Final = 1.0
"""Real time without an answer after which a withdrawal waits no longer."""
_EVERY_S: Final = 0.1
"""Real time between two tests while an answer is awaited."""

_of_thread = threading.local()


class Hurried(ControllerLost):
    """The error that an answer was not awaited any longer, for the sake of a withdrawal."""


@contextmanager
def hurried_by(withdraws: Callable[[], bool]) -> Iterator[None]:
    """Let `withdraws` end waits of this thread: it returns True while a withdrawal of the tip waits."""
    _of_thread.withdraws = withdraws
    try:
        yield
    finally:
        _of_thread.withdraws = None


def step_s(left_s: float) -> float:
    """Return how long to wait before the next test: all of `left_s` in a thread that nothing hurries."""
    return left_s if getattr(_of_thread, "withdraws", None) is None else min(left_s, _EVERY_S)


@contextmanager
def unhurried() -> Iterator[None]:
    """Let waits of this thread last as long as usual: there is no other way left."""
    before, _of_thread.withdraws = getattr(_of_thread, "withdraws", None), None
    try:
        yield
    finally:
        _of_thread.withdraws = before


def end_if_hurried(silent_s: float, what: str) -> None:
    """Raise Hurried if a withdrawal waits for the answer to `what`, `silent_s` after the last byte."""
    withdraws = getattr(_of_thread, "withdraws", None)
    if silent_s >= SILENT_S and withdraws is not None and withdraws():
        raise Hurried(f"no answer to {what} for {SILENT_S:g} s, and a withdrawal of the tip waits")
