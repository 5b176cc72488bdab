"""`afspm run --ask`: who measures what, asked in the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import typer

if TYPE_CHECKING:
    from afspm.experiment import Experiment

_QUESTIONS: Final = {
    "sample": "Sample",
    "person": "Your name",
    "orcid": "Your ORCID iD",
    "project": "Project",
    "technique": "Technique (STM, STS or AFM)",
}


def ask(experiment: Experiment) -> dict[str, str]:
    """Ask what [metadata] of the file, and the class of the microscope, leave open or may have changed."""
    known = experiment.resolved.metadata()
    return {name: answer for name, text in _QUESTIONS.items() if (answer := _answer(name, text, known.get(name, "")))}


def _answer(name: str, text: str, known: str) -> str:
    """Ask until the answer is right; empty: it is not known."""
    import pydantic

    from afspm.experiment.sections import MetadataSection

    while answer := typer.prompt(text, default=known, show_default=bool(known)).strip():
        try:
            return str(getattr(MetadataSection.model_validate({name: answer}), name))
        except pydantic.ValidationError as error:
            typer.echo(f"  {error.errors()[0]['msg'].removeprefix('Value error, ')}")
    return ""
