"""The second connection: calls of Nanonis that last as long as what they wait for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from queue import SimpleQueue
from threading import Thread
from typing import Final

import numpy as np

from afspm.errors import AfspmError
from afspm.microscopes.nanonis.link import Link
from afspm.microscopes.nanonis.protocol import BadReply
from afspm.translator.driver import ControllerLost

_WAIT_MS: Final = 1000
_LONGEST_CURVE_S: Final = 24 * 3600.0


@dataclass(frozen=True)
class ScanEnded:
    """A scan came to its end, or was broken off.

    Attributes:
        path: where Nanonis saved it, as its own computer calls it; empty if it did not.
    """

    path: str


@dataclass(frozen=True)
class CurveEnded:
    """A spectrum came to its end.

    Attributes:
        names: of the channels, with units.
        values: [channels, points].
    """

    names: tuple[str, ...]
    values: np.ndarray


@dataclass(frozen=True)
class Failed:
    """What was waited for can't be waited for."""

    error: AfspmError


Heard = ScanEnded | CurveEnded | Failed
_Job = Callable[[], Heard | None]


class Listener:
    """Waits in a thread of its own for one thing at a time.

    Args:
        wake: called from that thread when there is something in `heard`.
    """

    def __init__(self, link: Link, wake: Callable[[], None]) -> None:
        self._link = link
        self._wake = wake
        self._jobs: SimpleQueue[_Job | None] = SimpleQueue()
        self._heard: SimpleQueue[Heard] = SimpleQueue()
        self._for_scan = self._closed = False
        Thread(target=self._work, name="Nanonis' second connection", daemon=True).start()

    def scan(self) -> None:
        """Wait for the end of a scan, if that is not being done already."""
        if not self._for_scan:
            self._for_scan = True
            self._jobs.put(self._next_end_of_scan)

    def curve(self, module: str, base_name: str) -> None:
        """Take a spectrum with a module and wait for its data."""
        self._for_scan = False
        self._jobs.put(lambda: self._curve(module, base_name))

    def heard(self) -> list[Heard]:
        """What has come since the last time."""
        found = []
        while not self._heard.empty():
            found.append(self._heard.get())
        return found

    def close(self) -> None:
        """End the thread, whatever it waits for."""
        self._closed = True
        self._link.close()
        self._jobs.put(None)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None and not self._closed:
            result: Heard | None
            try:
                result = job()
            except AfspmError as error:
                self._for_scan = False
                result = Failed(error)
            except Exception as error:  # whatever it says, this connection goes on being listened to, or is made anew
                self._for_scan = False
                result = Failed(BadReply(f"what Nanonis says of a measurement can't be: {error!r}"))
            if self._closed:
                return
            if result is not None:
                self._heard.put(result)
                self._wake()
            if isinstance(result, Failed) and isinstance(result.error, ControllerLost):
                return

    def _next_end_of_scan(self) -> Heard | None:
        """Asked again and again: so a connection that has died is noticed, and a spectrum gets its turn."""
        while self._for_scan and not self._closed:
            timed_out, path = self._link.ask("Scan.WaitEndOfScan", _WAIT_MS, longer_s=_WAIT_MS / 1000)
            if not timed_out:
                self._for_scan = False
                return ScanEnded(path)
        return None

    def _curve(self, module: str, base_name: str) -> Heard:
        with_data = 1
        names, values, _ = self._link.ask(f"{module}.Start", with_data, base_name, longer_s=_LONGEST_CURVE_S)
        return CurveEnded(tuple(names), values)
