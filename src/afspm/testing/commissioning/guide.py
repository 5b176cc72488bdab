"""`Guide`: gives a step access to the microscope and to the person at the panel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

from afspm.basics.clock import Clock
from afspm.basics.errors import UnitError
from afspm.basics.formatting import quantity
from afspm.basics.units import convert, parse_quantity
from afspm.model import Scan
from afspm.testing.commissioning.maker_claims import LOOKS, MakerClaim
from afspm.testing.commissioning.progress import CommissioningStep
from afspm.testing.conformance import Declined, Failed, Lost, Skipped, Unsupported, near
from afspm.testing.translators.measuring import CheckMeasurements
from afspm.translator.parameters import ParameterSpec


class Prompts(Protocol):
    """The person's answers: from the terminal, or scripted in a test."""

    def show(self, text: str) -> None: ...

    def confirm(self, question: str) -> bool:
        """Ask a yes-or-no question; return False without an answer."""

    def text(self, question: str) -> str:
        """Ask for a line, which may be empty."""

    def choose(self, question: str, options: Sequence[str], default: str = "") -> str:
        """Ask for one of the options; an empty answer selects the default, if any."""


UNSEEN = "unseen"
_TRIES: Final = 5
"""Most questions for one value."""
_FURTHER: Final = (
    "The next steps try how the maker's program behaves by itself, which was never seen. They take some 15 minutes "
    "at the panel, and your first night does not need them. Go through them?"
)
NO_PANEL = "a simulated microscope has no panel"


@dataclass
class Guide:
    """The fixture of the steps of one commissioning.

    Attributes:
        folder: the run folder, for pictures.
        has_panel: True for a real controller. Without a panel, each question about it is shown and skipped.
        has_tip: False for a microscope without a tip, where the steps about it are left out.
        has_lines: False for a controller whose lines are not published while it scans.
        program_s: real seconds that the controller's program may need beside measuring; see `Driver.program_s`.
        counts_clockwise: True if the controller's panel shows angles clockwise.
        approaches: True for a simulated tip, which no person can bring to the sample.
        in_contact: True if the person has approached the tip, which is withdrawn after the steps at the sample.
        is_remote: True if the controller runs on another computer.
        rows: the driver's rows of the settings for which a measurement stands, and of the height of the tip.
        section: the translator's section in the experiment file.
        claims: the driver's claims about the maker's program, by id.
        seen: the observations that settle claims, by the names in `MakerClaim.commission`: True if the claim holds.
        scans: the scans that a report for others needs, all channels of each, by a name.
        unprepared: the claims whose preparation the person has not confirmed: no step settles them.
    """

    kit: CheckMeasurements
    prompts: Prompts
    folder: Path
    has_panel: bool = True
    has_tip: bool = True
    has_lines: bool = True
    program_s: float = 0.0
    counts_clockwise: bool = False
    approaches: bool = False
    in_contact: bool = False
    is_remote: bool = False
    rows: Mapping[str, ParameterSpec] = field(default_factory=dict)
    section: str = ""
    claims: Mapping[str, MakerClaim] = field(default_factory=dict)
    seen: dict[str, bool] = field(default_factory=dict)
    scans: dict[str, list[Scan]] = field(default_factory=dict)
    unprepared: set[str] = field(default_factory=set)
    _is_unseen: bool = False
    _further: bool | None = None

    @property
    def clock(self) -> Clock:
        return self.kit.clock

    def perform(self, step: CommissioningStep) -> str:
        """Explain a step, ask for confirmation if it moves anything, and run it.

        Raises:
            CheckEnded: the step failed, was skipped or declined, or is not supported.
        """
        if missing := self.kit.support.missing(step.needs):
            raise Unsupported(", ".join(missing))
        if step.about_tip and not self.has_tip:
            raise Unsupported("this microscope has no tip")
        if step.about_lines and not self.has_lines:
            raise Unsupported("no line of a running scan is published")
        if step.for_claims and not any(one.step == step.name for one in self.claims.values()):
            raise Unsupported("no claim of this driver depends on it")
        self.prompts.show(f"\n{step.title}\n{step.explained}")
        if step.needs_panel and not self.has_panel:
            raise Skipped(f"{NO_PANEL} or cable")
        if step.for_claims and not self._wants_further():
            raise Skipped("left out")
        self._is_unseen = False
        self._prepare(step)
        if step.moves and not self.prompts.confirm("Shall afspm do this now?"):
            raise Declined("not confirmed")
        line = step.do(self) or ""
        # a step passes without a panel, too, and then shows less of the maker's program
        if not self._is_unseen:
            self.seen[step.name] = True
        return line

    def _wants_further(self) -> bool:
        if self._further is None:
            self._further = self.prompts.confirm(_FURTHER)
        return self._further

    def _prepare(self, step: CommissioningStep) -> None:
        for name, claim in self.claims.items():
            if claim.ask and claim.step == step.name != LOOKS:
                question = f"{claim.ask} Is it so?"
                if not (self._can_be_seen(question) and self.prompts.confirm(question)):
                    self.unprepared.add(name)

    def explain(self, step: CommissioningStep, failure: Failed) -> tuple[str, ...]:
        """Stop the microscope's activity, and return the remedy.

        Raises:
            Lost: the activity does not stop.
        """
        try:
            self.kit.client.come_to_rest()
        except Failed as restless:
            raise Lost(str(restless)) from restless
        return (f"What to do: {step.remedy}",)

    def unseen(self) -> str:
        """Return the result line of a step that was not observed at the panel.

        Raises:
            Skipped: the controller has a panel.
        """
        line = "set and read back; not seen at the panel"
        if self.has_panel:
            raise Skipped(line)
        return line

    def require(self, question: str, expected: str) -> None:
        """Ask the person to confirm.

        Raises:
            Failed: the person says no.
        """
        if not self.prompts.confirm(question):
            raise Failed(expected, "the person says no")

    def require_at_panel(self, question: str, expected: str) -> None:
        """Ask the person to confirm at the panel, if there is one; what can't be seen there settles nothing.

        Raises:
            Failed: the person says no.
        """
        if not self._can_be_seen(question):
            return
        seen = self.prompts.choose(question, ("yes", "no", UNSEEN), UNSEEN)
        self._is_unseen |= seen == UNSEEN
        if seen == "no":
            raise Failed(expected, "the person says no")

    def at_panel(self, question: str) -> str | None:
        """Ask for a line of text about the panel; return None without a panel."""
        return self.prompts.text(question) if self._can_be_seen(question) else None

    def require_choice(self, question: str, right: str, wrong: Sequence[str], what: str, shows: str = "") -> bool:
        """Ask which option the panel shows; return False if the person can't see any option.

        Args:
            shows: the name of the observation in `seen`, if it settles a claim.

        Raises:
            Failed: a wrong option.
        """
        if not self._can_be_seen(question):
            return False
        seen = self.prompts.choose(question, [right, *wrong, UNSEEN], UNSEEN)
        if seen != UNSEEN:
            self.seen[shows] = seen == right
        if seen not in (right, UNSEEN):
            raise Failed(f"{what}: {right}", f"{seen} at the panel")
        return seen == right

    def compare(self, what: str, value: float, unit: str, absolute: float = 0.0, shows: str = "") -> bool:
        """Ask for a value shown at the panel; return False if the panel does not show the value.

        The person types the value before afspm shows its own: a person who knows the expected value may misread a wrong
        value.

        Args:
            shows: the name of the observation in `seen`, if it settles a claim.

        Raises:
            Failed: the values differ by more than 1 % and `absolute`, and the person confirms the typed value.
            Skipped: no answer could be compared.
        """
        shown = f"{value:.6g} {unit}".rstrip()
        question = f"{what}, as the panel shows it{f', e.g. in {unit}' if unit else ''}"
        if not self._can_be_seen(question):
            return False
        for _ in range(_TRIES):
            typed = self.prompts.text(question)
            if not typed.strip():
                return False
            try:
                at_panel = _in_unit(typed.strip(), unit)
            except UnitError as error:
                self.prompts.show(f"  not understood: {error}")
                continue
            if near(at_panel, value, relative=0.01, absolute=absolute):
                self.prompts.show(f"  afspm reads {shown}: the same")
                self.seen[shows] = True
                return True
            if self.prompts.confirm(f"  afspm reads {shown}, which is not {typed}. Is {typed} what the panel shows?"):
                self.seen[shows] = False
                raise Failed(f"{what} as at the panel, {typed}", shown)
        raise Skipped(f"{what}: none of {_TRIES} answers could be compared with {shown}")

    def propose_resolution(self, row: ParameterSpec, readings: Sequence[float]) -> str:
        """Propose a `resolution` where readings of a steady value differ by more than the row allows.

        Args:
            readings: in the unit that the translator answers in.

        Returns:
            the difference of the largest and the smallest, as text; empty: the row allows it.
        """
        ends = [float(row.parse(f"{end!r}", row.wire_unit)) for end in (min(readings), max(readings))]
        if row.same(*ends):
            return ""
        spread = ends[1] - ends[0]
        self.prompts.show(
            f"  For the experiment file, unless it was changed meanwhile:\n"
            f'  [{self.section}.parameters.{row.name}]\n  resolution = "{quantity(2.0 * spread, row.si_unit, 2)}"'
        )
        return quantity(spread, row.si_unit, 2)

    def compare_angle(self, turned_deg: float) -> bool:
        """Compare a counter-clockwise angle with the number at the panel, which may count clockwise."""
        return self.compare("angle", -turned_deg if self.counts_clockwise else turned_deg, "deg", 0.2)

    def _can_be_seen(self, question: str) -> bool:
        if not self.has_panel:
            self.prompts.show(f"  {question} – skipped: {NO_PANEL}")
            self._is_unseen = True
        return self.has_panel


def _in_unit(typed: str, unit: str) -> float:
    number, own = parse_quantity(typed.replace("°", "deg"))
    return convert(number, own or unit, unit)
