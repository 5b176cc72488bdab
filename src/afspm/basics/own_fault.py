"""Faults of a component's own code, which recur after a restart."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class OwnFault:
    """An error of a component's own code that ended the component.

    A restarted component continues from its memory and its saved measurements. If both are unchanged when the same
    fault occurs again, every further restart would fail in the same way, and repeat its requests to the microscope.

    Attributes:
        error: type of the exception, since its text may differ after a restart.
        place: file and line in the component's code.
        kept: checksum of memory and saved measurements.
    """

    error: str
    place: str
    kept: int

    def __str__(self) -> str:
        return f"{self.error} at {self.place}"
