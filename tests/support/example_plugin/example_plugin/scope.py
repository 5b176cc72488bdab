"""A driver: the simulated microscope under another name."""

from __future__ import annotations

from afspm.emulation import Simulator


class ExampleScope(Simulator):
    """A microscope of the laboratory."""
