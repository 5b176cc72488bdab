"""`Scope`: the blocking handle on an experiment, for scripts, notebooks and `Component.run`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

from afspm.model import (
    ControlMode,
    ControlState,
    Feedback,
    ProbePosition,
    Region,
    ScanParameters,
    ScanSet,
    ScopeState,
    Spectrum,
)


@dataclass(frozen=True, slots=True)
class Event:
    """Something that was published: `message` is an object of `afspm.model` or a generated message."""

    envelope: str
    message: Any
    time_ns: int | None


class Scope:
    """What an experiment asks of the microscope. Every call blocks until it is done; nothing is polled.

    Control is asked for by itself and given back after each call; `with scope.control():` keeps it over several. Where
    it is refused or taken away, calls wait until it is back. All timeouts are real seconds; None waits for ever.

    Raises, from every call:
        Refused: scheduler or microscope said no; it says why.
        NoResponse: the time given was up.
        ExperimentEnded: there is nothing more to ask.
    """

    def scan(
        self,
        region: Region | None = None,
        *,
        shape: tuple[int, int] | None = None,
        key: str | None = None,
        timeout_s: float | None = None,
    ) -> ScanSet: ...

    def spectrum(
        self,
        at: tuple[float, float] | None = None,
        *,
        kind: str | None = None,
        key: str | None = None,
        timeout_s: float | None = None,
    ) -> Spectrum: ...

    def set(self, parameter: str, value: float | str, unit: str | None = None) -> float | str: ...

    def get(self, parameter: str, unit: str | None = None) -> float | str: ...

    def set_feedback(
        self,
        *,
        on: bool | None = None,
        proportional_gain: float | None = None,
        integral_gain: float | None = None,
        setpoint: float | None = None,
    ) -> None: ...

    def move_probe(self, xy_m: tuple[float, float]) -> None: ...

    def action(self, name: str) -> None: ...

    def supports(self, action: str) -> bool: ...

    def control(
        self, *, solving: int | str | None = None, timeout_s: float | None = None
    ) -> AbstractContextManager[None]: ...

    def flag(self, problem: int | str) -> None: ...

    def clear(self, problem: int | str) -> None: ...

    def set_mode(self, mode: ControlMode) -> None: ...

    def end_experiment(self) -> None: ...

    def events(self, *envelopes: str, timeout_s: float | None = None) -> Iterator[Event]: ...

    def wait_until(self, condition: Callable[[], bool], *, timeout_s: float | None = None) -> None: ...

    def sleep(self, experiment_s: float) -> None: ...

    @property
    def state(self) -> ScopeState: ...

    @property
    def mode(self) -> ControlMode: ...

    @property
    def control_state(self) -> ControlState: ...

    @property
    def scan_parameters(self) -> ScanParameters | None: ...

    @property
    def feedback(self) -> Feedback | None: ...

    @property
    def probe_position(self) -> ProbePosition | None: ...
