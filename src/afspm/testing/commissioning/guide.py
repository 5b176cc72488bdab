"""What a step works with: the microscope through the suite's client, and the person at the panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from afspm.errors import UnitError
from afspm.testing.translators.measuring import CheckMeasurements
from afspm.testing.verdicts import Failed, Skipped, near
from afspm.units import convert, parse_quantity


class Prompts(Protocol):
    """The person: the terminal, or the answers of a test."""

    def show(self, text: str) -> None:
        """Show a text."""

    def confirm(self, question: str) -> bool:
        """Ask yes or no; without an answer it is no."""

    def text(self, question: str) -> str:
        """Ask for a line, which may be empty."""

    def choose(self, question: str, options: Sequence[str]) -> str:
        """Ask for one of the options."""


class StepDeclined(Exception):
    """The person did not confirm; nothing was done."""


UNSEEN = "unseen"


@dataclass
class Guide:
    """One commissioning as its steps see it.

    Attributes:
        folder: of the run, for pictures.
        in_contact: the person has approached; the tip is withdrawn when the steps at the sample are over.
        has_panel: True of a real controller; what has none can't be compared with it.
    """

    kit: CheckMeasurements
    prompts: Prompts
    folder: Path
    has_panel: bool = True
    in_contact: bool = False

    def unseen(self) -> str:
        """Return the line of a step whose outcome could not be seen at the panel; Skipped if there is one."""
        line = "set and read back; not seen at the panel"
        if self.has_panel:
            raise Skipped(line)
        return line

    def require(self, question: str, expected: str) -> None:
        """Ask the person; Failed unless it is so."""
        if not self.prompts.confirm(question):
            raise Failed(expected, "the person says no")

    def require_choice(self, question: str, right: str, wrong: Sequence[str], what: str) -> bool:
        """Ask for what is seen. Return False if it can't be seen; Failed if it is something else."""
        seen = self.prompts.choose(question, [right, *wrong, UNSEEN])
        if seen not in (right, UNSEEN):
            raise Failed(f"{what}: {right}", f"{seen} at the panel")
        return seen == right

    def compare(self, what: str, value: float, unit: str, absolute: float = 0.0) -> bool:
        """Ask for a value as the panel shows it. Return False if it is not shown; Failed if it is another.

        The person types it before afspm's is shown: so a wrong one is not read as the right one.
        """
        shown = f"{value:.6g} {unit}".rstrip()
        while True:
            typed = self.prompts.text(f"{what}, as the panel shows it{f', e.g. in {unit}' if unit else ''}")
            if not typed.strip():
                return False
            try:
                at_panel = _in_unit(typed.strip(), unit)
            except UnitError as error:
                self.prompts.show(f"  not understood: {error}")
                continue
            if near(at_panel, value, relative=0.01, absolute=absolute):
                self.prompts.show(f"  afspm reads {shown}: the same")
                return True
            if self.prompts.confirm(f"  afspm reads {shown}, which is not {typed}. Is {typed} what the panel shows?"):
                raise Failed(f"{what} as at the panel, {typed}", shown)


def _in_unit(typed: str, unit: str) -> float:
    number, own = parse_quantity(typed.replace("°", "deg"))
    return convert(number, own or unit, unit)
