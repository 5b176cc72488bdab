"""Faults of a component's own code, which a restart meets again."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class OwnFault:
    """The end of a component by an error of its own code.

    A restart begins with what the component keeps: its memory and its keyed measurements. A life that leaves this as it
    was has made no progress. Two equal faults in a row are therefore one that a restart repeats, with all that the
    component does to the microscope before it.

    Attributes:
        error: the type of the exception; its text may differ from life to life.
        place: file and line in the component's code.
        kept: a checksum of what is kept.
    """

    error: str
    place: str
    kept: int

    def __str__(self) -> str:
        return f"{self.error} at {self.place}"
