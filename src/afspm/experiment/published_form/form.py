"""File form of the published implementation, for the entry point `afspm.forms`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from afspm.experiment.published_form.files import convert

if TYPE_CHECKING:
    from afspm.experiment.document import Document
    from afspm.experiment.findings import SourceLocation
    from afspm.experiment.parts import ExperimentParts
    from afspm.experiment.resolved_experiment import ResolvedExperiment
    from afspm.experiment.toml_lines import Settings


class PublishedForm:
    """File form of the published implementation; see `experiment.forms.FileForm`."""

    def convert(self, tables: dict[str, Settings], parts: ExperimentParts, document: Document) -> dict[str, Settings]:
        """Return the components of a file in afspm's form; see `files.convert`."""
        return convert(tables, parts, document)

    def explained(self, resolved: ResolvedExperiment) -> list[tuple[SourceLocation, str, str]]:
        """Return the location, the setting and afspm's equivalent of each line of the file."""
        from afspm.experiment.published_form.short_form import explained  # not needed to run a file

        return explained(resolved)

    def short(self, resolved: ResolvedExperiment) -> str:
        """Return the experiment as a file in afspm's short form."""
        from afspm.experiment.published_form.short_form import short

        return short(resolved)


FORM: Final = PublishedForm()
