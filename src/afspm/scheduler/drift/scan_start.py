"""When the running scan began, from what the microscope says of its state."""

from __future__ import annotations

from dataclasses import dataclass, replace

from afspm.model import ScopeState, ScopeStatus


@dataclass(frozen=True)
class ScanStart:
    """A scan that has begun.

    Attributes:
        time_s: experiment time.
        upwards: direction of its slow axis; None: not known.
        was_paused: not all of its rows followed each other at once.
    """

    time_s: float
    upwards: bool | None
    was_paused: bool = False


class ScanStartTracker:
    """Follows the state. That it scans is told again after a pause, and to a scheduler that was started anew: then the
    scan began before."""

    def __init__(self) -> None:
        self._begun: ScanStart | None = None
        self._is_scanning = False

    def state(self, status: ScopeStatus, time_s: float, upwards: bool | None) -> None:
        """The microscope has told its state; `upwards`: the direction in force. One that is lost scans on."""
        if status.state is ScopeState.UNDEFINED:
            return
        is_new, self._is_scanning = not self._is_scanning, status.state is ScopeState.SCANNING
        if not self._is_scanning:
            return
        if is_new:
            self._begun = ScanStart(time_s, upwards, status.paused is True)
        elif self._begun is not None and status.paused is True:
            self._begun = replace(self._begun, was_paused=True)

    def scan_came(self) -> None:
        """It is over: should it scan on without another state between them, that is the next one."""
        self._is_scanning = False

    def of_scan(self, end_s: float) -> ScanStart | None:
        """That of the scan which ended at a time; None: it is not known."""
        return self._begun if self._begun is not None and self._begun.time_s < end_s else None
