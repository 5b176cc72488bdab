"""Other forms of experiment files, which plug-ins convert into afspm's form."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Protocol

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError
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
def all_forms() -> tuple[tuple[FileForm, ...], tuple[ConfigError, ...]]:
    """Return all installed forms, and an error for each form that can't be loaded."""
    forms, errors = [], []
    for name in entry_points.names(entry_points.FORMS):
        try:
            forms.append(entry_points.load(entry_points.FORMS, name))
        except ConfigError as error:  # most files need no form but afspm's own
            errors.append(error)
    return tuple(forms), tuple(errors)
