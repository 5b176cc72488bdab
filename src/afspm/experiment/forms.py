"""Other forms of experiment files, which plug-ins convert into afspm's form."""

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
        """Return place, setting and afspm's equivalent of the setting, for each line of the file."""

    def short(self, resolved: ResolvedExperiment) -> str:
        """Return the experiment as a file in afspm's form."""


@cache
def all_forms() -> tuple[FileForm, ...]:
    """Return all installed forms. Raises ConfigError if a form can't be loaded."""
    return tuple(entry_points.load(entry_points.FORMS, name) for name in entry_points.names(entry_points.FORMS))
