"""Fault injection: kinds and times of faults of a simulated microscope or an emulated controller."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Final

from afspm.basics.errors import ConfigError
from afspm.basics.plain_data import Plain, PlainMapping

EVERY_TIME = 1_000_000_000
INSTRUMENT_FAULTS: Final[Mapping[str, str]] = {
    "scan-refused": "a scan does not begin, without an error",
    "spectrum-refused": "a curve does not begin, without an error",
    "stopped": "a scan is stopped at the panel",
    "withdrawn": "the tip is withdrawn at the panel during a scan, which ends",
    "no-file": "a scan or curve is not saved",
    "late-file": "a file appears only after the duration",
    "half-file": "the second half of a file appears only after the duration",
}
"""The faults of any microscope, except connection faults."""


@dataclass(frozen=True)
class Fault:
    """A fault to inject.

    Attributes:
        kind: a kind of the microscope or the emulator.
        at_s: earliest time of the fault, in experiment seconds after the start.
        count: how many times the fault occurs.
        duration_s: for kinds with a duration (experiment seconds).
    """

    kind: str
    at_s: float = 0.0
    count: int = 1
    duration_s: float = 1.0

    def __post_init__(self) -> None:
        if not (self.at_s >= 0 and self.count >= 1 and self.duration_s >= 0):
            raise ConfigError(f"{self} can never happen", where="faults", hint="at_s >= 0, count >= 1, duration_s >= 0")

    @classmethod
    def parse(cls, text: str) -> Fault:
        """Parse `KIND[@SECONDS][,count=N][,duration=SECONDS]` of the command line; `count=every` has no limit.

        Raises:
            ConfigError: the text has another form.
        """
        head, *settings = text.split(",")
        kind, _, at = head.partition("@")
        try:
            fault = cls(kind.strip(), float(at) if at else 0.0)
            for setting in settings:
                name, _, value = setting.partition("=")
                if name.strip() == "count":
                    count = EVERY_TIME if value.strip() == "every" else int(value)
                    fault = replace(fault, count=count)
                elif name.strip() == "duration":
                    fault = replace(fault, duration_s=float(value))
                else:
                    raise ValueError(name)
        except ValueError as error:
            hint = "KIND[@SECONDS][,count=N][,duration=SECONDS]"
            raise ConfigError(f"{text!r} is not a fault: {error}", where="--fault", hint=hint) from error
        return fault

    @classmethod
    def of(cls, given: str | PlainMapping | Fault) -> Fault:
        """Create a fault from a text as on the command line, or from a table of the experiment file.

        Raises:
            ConfigError: the text or the table has another form.
        """
        if isinstance(given, Fault):
            return given
        if isinstance(given, str):
            return cls.parse(given)
        try:
            return cls(**given)
        except TypeError as error:
            raise ConfigError(f"{dict(given)} is not a fault: {error}", where="faults") from error


class Faults:
    """The faults of one simulated microscope or emulator.

    Args:
        faults: in any order.
        known: all kinds, with the effect of each.
        start_s: the experiment time from which `Fault.at_s` counts.
        kept: JSON-able storage for the remaining faults, so that they outlive a restart (a crash strikes once).

    Attributes:
        known: all kinds, with the effect of each.

    Raises:
        ConfigError: an unknown kind.
    """

    def __init__(
        self, faults: Iterable[Fault], known: Mapping[str, str], start_s: float, kept: Plain | None = None
    ) -> None:
        self.known = known
        self._start_s = start_s
        self._kept: Plain = {} if kept is None else kept
        given = list(faults)
        for number, fault in enumerate(given):
            self._check(fault.kind, f"faults[{number}].kind")
        left = [Fault(**one) for one in self._kept["left"]] if "left" in self._kept else given
        self._left = sorted(left, key=lambda fault: fault.at_s)
        self._keep()

    def demand(self, fault: Fault, now_s: float) -> None:
        """Add a fault; its time counts from now."""
        self._check(fault.kind)
        self._left.append(replace(fault, at_s=now_s - self._start_s + fault.at_s))
        self._keep()

    def strikes(self, kind: str, now_s: float) -> Fault | None:
        """Return and count the fault of this kind that is due now; None without one.

        Call this method once at the point where this kind has its effect: each fault returned uses up one of `count`.
        """
        self._check(kind)
        for i, fault in enumerate(self._left):
            if fault.kind == kind and self._start_s + fault.at_s <= now_s:
                if fault.count > 1:
                    self._left[i] = replace(fault, count=fault.count - 1)
                else:
                    del self._left[i]
                self._keep()
                return fault
        return None

    def lasts(self, kind: str, now_s: float) -> bool:
        """Return whether a fault of this kind is active: from its time on for its duration."""
        self._check(kind)
        begun = ((self._start_s + fault.at_s, fault.duration_s) for fault in self._left if fault.kind == kind)
        return any(at_s <= now_s < at_s + duration_s for at_s, duration_s in begun)

    def next_s(self, now_s: float) -> float | None:
        """Return the time at which the next fault begins or ends; None if there is none."""
        times = (self._start_s + fault.at_s + after_s for fault in self._left for after_s in (0.0, fault.duration_s))
        return min((at_s for at_s in times if at_s > now_s), default=None)

    def _keep(self) -> None:
        self._kept["left"] = [asdict(fault) for fault in self._left]

    def _check(self, kind: str, where: str = "faults") -> None:
        if kind not in self.known:
            near = difflib.get_close_matches(kind, self.known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(self.known)}"
            raise ConfigError(f"there is no fault {kind!r}", where=where, hint=hint)
