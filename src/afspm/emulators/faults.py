"""Fault injection: which faults strike an emulated controller, and when."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from afspm.errors import ConfigError
from afspm.plain_data import PlainMapping

EVERY_TIME = 1_000_000_000


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: one that the emulator knows.
        at_s: experiment seconds after the emulator was started, from which on it strikes.
        count: how many times.
        duration_s: how long it lasts, for kinds that last (experiment seconds).
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
        """Parse `KIND[@SECONDS][,count=N][,duration=SECONDS]` of the command line; count=every for each time.

        Raises:
            ConfigError: it is not of that form.
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
        """Make a fault from a text as on the command line, or from a table of the experiment file."""
        if isinstance(given, Fault):
            return given
        if isinstance(given, str):
            return cls.parse(given)
        try:
            return cls(**given)
        except TypeError as error:
            raise ConfigError(f"{dict(given)} is not a fault: {error}", where="faults") from error


class Faults:
    """The faults of one emulator.

    Args:
        faults: in any order.
        known: the kinds that it has, with what each does.
        start_s: experiment time that `Fault.at_s` counts from.

    Raises:
        ConfigError: a kind that it does not have.
    """

    def __init__(self, faults: Iterable[Fault], known: Mapping[str, str], start_s: float) -> None:
        self._known = known
        self._start_s = start_s
        self._left: list[Fault] = []
        for fault in faults:
            self._check(fault.kind)
            self._left.append(fault)
        self._left.sort(key=lambda fault: fault.at_s)

    def demand(self, fault: Fault, now_s: float) -> None:
        """One more, its time counted from now."""
        self._check(fault.kind)
        self._left.append(replace(fault, at_s=now_s - self._start_s + fault.at_s))

    def strikes(self, kind: str, now_s: float) -> Fault | None:
        """Return the fault if one of this kind strikes now, and count it.

        Ask once at the point where this kind would show: each time uses up one of `count`.
        """
        self._check(kind)
        for i, fault in enumerate(self._left):
            if fault.kind == kind and self._start_s + fault.at_s <= now_s:
                if fault.count > 1:
                    self._left[i] = replace(fault, count=fault.count - 1)
                else:
                    del self._left[i]
                return fault
        return None

    def lasts(self, kind: str, now_s: float) -> bool:
        """True while a fault of this kind lasts: from its time on for its duration."""
        self._check(kind)
        begun = ((self._start_s + fault.at_s, fault.duration_s) for fault in self._left if fault.kind == kind)
        return any(at_s <= now_s < at_s + duration_s for at_s, duration_s in begun)

    def next_s(self, now_s: float) -> float | None:
        """Return the time at which the next fault begins or ends; None if there is none."""
        times = (self._start_s + fault.at_s + after_s for fault in self._left for after_s in (0.0, fault.duration_s))
        return min((at_s for at_s in times if at_s > now_s), default=None)

    def _check(self, kind: str) -> None:
        if kind not in self._known:
            near = difflib.get_close_matches(kind, self._known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(self._known)}"
            raise ConfigError(f"there is no fault {kind!r}", where="faults", hint=hint)
