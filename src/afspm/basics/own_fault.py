"""Faults of a component's own code, which recur after a restart."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class OwnFault:
    """An error of a component's own code that ended the component.

    A restart begins with the component's memory and keyed measurements. If a life ends with both unchanged, it has made
    no progress. So two equal faults in a row will recur after every restart, and repeat every request to the microscope
    before them.

    Attributes:
        error: the type of the exception; its text may differ from life to life.
        place: file and line in the component's code.
        kept: a checksum of memory and keyed measurements.
    """

    error: str
    place: str
    kept: int

    def __str__(self) -> str:
        return f"{self.error} at {self.place}"
