"""Publication of finished scans and spectra: each reaches a subscriber once, even if the process is killed.

A subscriber recognises a duplicate by its time. So the times are saved before publishing; after a kill in between, the
same results are published again at the same times.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from afspm.basics.errors import AfspmError
from afspm.basics.plain_data import Plain
from afspm.model import MeasurementConditions, Parameter, Scan, ScopeState, Spectrum
from afspm.model.caption import as_parameters
from afspm.translator.driver_base import DriverBase
from afspm.translator.judge import Stated
from afspm.wire import encode
from afspm.wire.messages import CONDITIONS

KEPT_FOR_REPLAY = 8
"""The number of last results published again after a restart, for a scheduler that had not received them."""


class Outgoing(NamedTuple):
    """A message to publish at a given time."""

    envelope: str
    payload: bytes
    time_ns: int


class _Loaded(NamedTuple):
    """A result as messages, with the kind, the time and the file of its measurement, and calibrations of this file."""

    messages: list[tuple[str, bytes]]
    kind: ScopeState
    time_ns: int | None
    filename: str
    stated: tuple[Parameter, ...]


class Outbox:
    """New results of the controller, converted to packets.

    Args:
        microscope: the driver that lists and loads the results.
        kept: the outbox's part of the translator's memory; the memory's owner saves it.
        stamp: returns `count` strictly increasing times, ns.
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
        self._read: dict[str, _Loaded] = {}
        self._complained: set[str] = set()

    def start(self) -> list[Outgoing]:
        """Return the packets to publish again after connecting; results from before the experiment are ignored.

        Returns:
            the packets of the last results, which an earlier process may have published; results that can't be read
            again are left out.
        """
        # at the first start of the experiment, all results listed are older
        if "known" not in self._kept:
            self._kept["known"] = list(self._microscope.results())
            self._kept["sent"] = []
            return []
        again = []
        for sent in self._kept["sent"]:
            loaded = self._load(sent["result"])
            if loaded is None:
                self._log.warning("%s can't be read again; it is not published again", sent["result"])
            else:
                conditions = CONDITIONS.name, bytes.fromhex(sent["conditions"])
                again += _packets([conditions, *loaded.messages], sent["times"])
        return again

    def look(self) -> bool:
        """Read new results; return True if any complete result is not yet published."""
        listed = list(self._microscope.results())
        known = set(self._kept["known"])
        new = [result for result in listed if result not in known]
        if len(known) > len(listed):  # a result that the microscope lists no longer need not be remembered
            self._kept["known"] = [result for result in self._kept["known"] if result in set(listed)]
        for result in new:
            if result not in self._read and (loaded := self._load(result)) is not None:
                self._read[result] = loaded
        return bool(self._read)

    def is_of(self, state: ScopeState) -> bool:
        """Return whether a new result is of the measurement of this state: a scan, or a spectrum."""
        return any(loaded.kind is state for loaded in self._read.values())

    def stated(self) -> list[Stated]:
        """Return what the new results say of their measurements."""
        return [self._microscope.stated(result) for result in self._read]

    def take(self, conditions: Callable[[int, str], MeasurementConditions]) -> list[Outgoing]:
        """Return the packets of the new results; save the memory before publishing them.

        Args:
            conditions: returns the conditions of a measurement, by the time and the file of its result. They precede
                it.
        """
        packets = []
        for result, loaded in self._read.items():
            # one time each: subscribers recognise a duplicate by its time
            times = self._stamp(1 + len(loaded.messages))
            of_it = conditions(times[0] if loaded.time_ns is None else loaded.time_ns, loaded.filename)
            told = encode(_with_stated(of_it, loaded.stated))
            packets += _packets([told, *loaded.messages], times)
            self._kept["known"].append(result)
            sent = {"result": result, "times": times, "conditions": told[1].hex()}
            self._kept["sent"] = [*self._kept["sent"], sent][-KEPT_FOR_REPLAY:]
        self._read.clear()
        return packets

    def discard(self) -> None:
        """Drop all new results: they belong to an interrupted measurement."""
        self._read.clear()
        known = set(self._kept["known"])
        self._kept["known"] += [result for result in self._microscope.results() if result not in known]

    def _load(self, result: str) -> _Loaded | None:
        try:
            found: list[Scan | Spectrum] = list(self._microscope.load(result))
            if blank := [one.channel for one in found if isinstance(one, Scan) and one.is_blank]:
                self._log.warning("%s has no value in %s: NaN alone", result, ", ".join(blank))
            first_ns = next((one.time_ns for one in found if one.time_ns is not None), None)
            filename = next((one.filename for one in found if one.filename), result)
            kind = ScopeState.SCANNING if any(isinstance(one, Scan) for one in found) else ScopeState.SPEC
            stated = as_parameters(found[0].in_force) if found else ()
            return _Loaded([encode(one) for one in found], kind, first_ns, filename, stated)
        except Exception as error:  # a reader may raise anything; a bad file must not end the process
            if result not in self._complained:
                why = error if isinstance(error, AfspmError | OSError) else f"{type(error).__name__}: {error}"
                self._log.warning("%s can't be read yet: %s; retrying", result, why)
                self._complained.add(result)
            return None


def _with_stated(conditions: MeasurementConditions, stated: tuple[Parameter, ...]) -> MeasurementConditions:
    # what was read of the controller counts more than what its file states
    known = {one.name for one in (*conditions.begin_in_force, *conditions.end_in_force)}
    new = tuple(one for one in stated if one.name not in known)
    begin, end = conditions.begin_in_force, conditions.end_in_force
    return replace(conditions, begin_in_force=(*begin, *new), end_in_force=(*end, *new))


def _packets(messages: list[tuple[str, bytes]], times: list[int]) -> list[Outgoing]:
    return [Outgoing(name, payload, time_ns) for (name, payload), time_ns in zip(messages, times, strict=True)]
