"""`python -m benchmarks.hops`: functions and modules of afspm on the way of one `scope.set`, and of one scan.

Measured on the bench, where all processes are in one: the second `set`, which takes control too, and the first scan
from its start to `on_scan`. Code of `testing` and `simulation` is not counted; the sockets are the bench's.
"""

from __future__ import annotations

import collections
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Self

import afspm
from afspm import Component, Region, ScopeState
from afspm.model import ScopeStatus
from afspm.testing import Bench

ROOT = Path(afspm.__file__).parent
NOT_COUNTED = {"testing", "simulation"}


@dataclass(frozen=True)
class Way:
    """What was called on a way."""

    functions: int
    calls: int
    modules: collections.Counter[str]
    """Their number by room, the first folder under `afspm`."""


class Counter:
    """Counts calls of afspm's functions while `counts` is true, in all threads that begin in its `with` block."""

    def __init__(self) -> None:
        self.counts = False
        self.calls: dict[tuple[str, str, int], int] = {}

    def __enter__(self) -> Self:
        """Watch this thread and all that begin later: a thread that runs already would not be counted."""
        threading.setprofile(self._called)
        sys.setprofile(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        threading.setprofile(None)
        sys.setprofile(None)

    def taken(self) -> Way:
        """Return what was called since the last time."""
        calls, self.calls, self.counts = self.calls, {}, False
        files = {Path(file).relative_to(ROOT) for file, _, _ in calls}
        return Way(len(calls), sum(calls.values()), collections.Counter(file.parts[0] for file in files))

    def _called(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or not self.counts:
            return
        file = Path(frame.f_code.co_filename)
        if file.is_relative_to(ROOT) and file.relative_to(ROOT).parts[0] not in NOT_COUNTED:
            key = (str(file), frame.f_code.co_name, frame.f_code.co_firstlineno)
            self.calls[key] = self.calls.get(key, 0) + 1


class Passenger(Component):
    """Sets a value twice and takes a scan, and counts what both run through."""

    counter = Counter()
    ways: dict[str, Way] = {}  # noqa: RUF012 - of the process: the bench runs a copy

    def run(self) -> None:
        """Set, set again, and scan."""
        self.scope.set("tip-bias-voltage", "100 mV")
        self.counter.counts = True
        self.scope.set("tip-bias-voltage", "200 mV")
        self.ways["one scope.set, with taking control"] = self.counter.taken()
        self.scope.scan(Region((0.0, 0.0), (1e-6, 1e-6)))


class Listener(Component):
    """Ends the count at the scan."""

    def on_state(self, status: ScopeStatus) -> None:
        """Begin to count when the scan is over."""
        Passenger.counter.counts |= status.state is ScopeState.SCANNING

    def on_scan(self, scan: afspm.Scan) -> None:
        """End the count."""
        if "one scan, from its start to on_scan" not in Passenger.ways:
            Passenger.ways["one scan, from its start to on_scan"] = Passenger.counter.taken()


def measured() -> dict[str, Way]:
    """Return both ways, by what they are of."""
    Passenger.ways.clear()
    with Passenger.counter:  # before the bench, which starts the threads of component and translator
        Bench(Passenger(), others={"listener": Listener()}).run(until="30 min")
    return dict(Passenger.ways)


def main() -> None:
    """Print both."""
    print(f"{'':36} {'modules':>8} {'functions':>10} {'calls':>8}")
    for name, way in measured().items():
        print(f"{name:36} {way.modules.total():>8} {way.functions:>10} {way.calls:>8}")
        print("    " + ", ".join(f"{room} {modules}" for room, modules in way.modules.most_common()))


if __name__ == "__main__":
    main()
