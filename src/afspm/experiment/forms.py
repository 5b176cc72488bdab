"""Experiment files of other forms, which plug-ins convert into ours."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Protocol

from afspm.basics import entry_points
from afspm.experiment.parts import Converter

if TYPE_CHECKING:
    from afspm.experiment.findings import SourceLocation
    from afspm.experiment.resolved_experiment import ResolvedExperiment


class FileForm(Converter, Protocol):
    """A form of experiment files, declared as an entry point of the group `afspm.forms`."""

    def explained(self, resolved: ResolvedExperiment) -> list[tuple[SourceLocation, str, str]]:
        """Return for each line of the file where it is, what it sets, and what has become of it."""

    def short(self, resolved: ResolvedExperiment) -> str:
        """Return the experiment as a file in our form."""


@cache
def all_forms() -> tuple[FileForm, ...]:
    """Return all forms that are installed. Raises ConfigError if one can't be loaded."""
    return tuple(entry_points.load(entry_points.FORMS, name) for name in entry_points.names(entry_points.FORMS))
