"""The metadata in every file of a run: its sample, people and microscope."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Final

import pydantic

from afspm.model import Role

if TYPE_CHECKING:
    from afspm.experiment.resolution import ResolvedExperiment, ResolvedProcess

_ORCID: Final = re.compile(r"(?:https://orcid\.org/)?(\d{4}-\d{4}-\d{4}-\d{3}[\dX])")


def _checked_orcid(text: str) -> str:
    """Return an ORCID iD as a URI. The last digit is checked after ISO 7064 (MOD 11-2)."""
    found = _ORCID.fullmatch(text)
    if found is None:
        raise ValueError("an ORCID iD looks like 0000-0002-1825-0097")
    digits = found[1].replace("-", "")
    total = 0
    for digit in digits[:-1]:
        total = (total + int(digit)) * 2
    if "0123456789X"[(12 - total % 11) % 11] != digits[-1]:
        raise ValueError("this is not an ORCID iD: its last digit does not match the others")
    return f"https://orcid.org/{found[1]}"


Orcid = Annotated[str, pydantic.AfterValidator(_checked_orcid)]


def of_run(resolved: ResolvedExperiment) -> dict[str, str]:
    """Return what the file says in [metadata], and what the class of the microscope says of itself."""
    said = {name: value for name, value in resolved.sections.metadata.model_dump().items() if value is not None}
    translators = resolved.with_role(Role.TRANSLATOR)
    return (_of_class(translators[0]) if translators else {}) | said


def _of_class(translator: ResolvedProcess) -> dict[str, str]:
    from afspm.translator.driver import Driver

    kind = translator.component
    if kind is None or not issubclass(kind, Driver):
        return {}
    about = {"vendor": kind.maker, "software": kind.software, "technique": kind.technique(translator.settings)}
    return {name: text for name, text in about.items() if text}
