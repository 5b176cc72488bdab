"""Finished scans and spectra on their way out: each is published once, also over a kill of the process.

A packet's time is what tells a subscriber that it has had it. So the times are written down before anything is
published; a process that was killed in between publishes the same results again at the same times.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import NamedTuple

from afspm.basics.errors import AfspmError
from afspm.basics.plain_data import Plain
from afspm.model import Scan, Spectrum
from afspm.translator.driver_base import DriverBase
from afspm.wire import encode

KEPT_FOR_REPLAY = 8
"""So many last results are published again after a restart, for a scheduler that had not got them."""


class Outgoing(NamedTuple):
    """A message to publish at a given time."""

    envelope: str
    payload: bytes
    time_ns: int


class Outbox:
    """Finds out which results are new, reads them and makes packets of them.

    Args:
        microscope: that has the results.
        kept: the part of the translator's memory that this is written to; whoever owns it saves it.
        stamp: gives `count` strictly increasing times, ns, for as many packets.
    """

    def __init__(
        self,
        microscope: DriverBase,
        kept: Plain,
        stamp: Callable[[int], list[int]],
        log: logging.Logger,
    ) -> None:
        self._microscope = microscope
        self._kept = kept
        self._stamp = stamp
        self._log = log
        self._read: dict[str, list[tuple[str, bytes]]] = {}
        self._complained: set[str] = set()

    def start(self) -> list[Outgoing]:
        """After connecting. What was there before the experiment is none of its results.

        Returns:
            the packets of the last results, published by an earlier process or meant to be.
        """
        if "known" not in self._kept:
            self._kept["known"] = list(self._microscope.results())
            self._kept["sent"] = []
            return []
        again = []
        for sent in self._kept["sent"]:
            messages = self._load(sent["result"])
            if messages is None:
                self._log.warning("%s can't be read again; it is not published again", sent["result"])
            else:
                again += _packets(messages, sent["times"])
        return again

    def look(self) -> bool:
        """Return True if there are new results that can be read."""
        listed = list(self._microscope.results())
        known = set(self._kept["known"])
        new = [result for result in listed if result not in known]
        if len(known) > len(listed):  # what the microscope no longer lists need not be remembered
            self._kept["known"] = [result for result in self._kept["known"] if result in set(listed)]
        for result in new:
            if result not in self._read and (messages := self._load(result)) is not None:
                self._read[result] = messages
        return bool(self._read)

    def take(self) -> list[Outgoing]:
        """The packets of the new results. To be published after the memory was saved."""
        packets = []
        for result, messages in self._read.items():
            times = self._stamp(len(messages))
            packets += _packets(messages, times)
            self._kept["known"].append(result)
            self._kept["sent"] = [*self._kept["sent"], {"result": result, "times": times}][-KEPT_FOR_REPLAY:]
        self._read.clear()
        return packets

    def discard(self) -> None:
        """All that is new is of something broken off, and is not published."""
        self._read.clear()
        known = set(self._kept["known"])
        self._kept["known"] += [result for result in self._microscope.results() if result not in known]

    def _load(self, result: str) -> list[tuple[str, bytes]] | None:
        try:
            found: list[Scan | Spectrum] = list(self._microscope.load(result))
            if blank := [one.channel for one in found if isinstance(one, Scan) and one.is_blank]:
                self._log.warning("%s has no value in %s: NaN alone", result, ", ".join(blank))
            return [encode(one) for one in found]
        except Exception as error:  # whatever is wrong with a file, the microscope is to be commanded
            if result not in self._complained:
                why = error if isinstance(error, AfspmError | OSError) else f"{type(error).__name__}: {error}"
                self._log.warning("%s can't be read yet: %s; retrying", result, why)
                self._complained.add(result)
            return None


def _packets(messages: list[tuple[str, bytes]], times: list[int]) -> list[Outgoing]:
    return [Outgoing(name, payload, time_ns) for (name, payload), time_ns in zip(messages, times, strict=True)]
