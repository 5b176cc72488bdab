"""The questions of a commissioning, with and without a panel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from afspm.model import Parameter, names
from afspm.testing.commissioning.guide import UNSEEN, Guide
from afspm.testing.commissioning.steps import all_steps, tip_shown
from afspm.testing.conformance import Failed, Skipped, Unsupported
from afspm.testing.translators.support import Support


@dataclass
class Person:
    answers: dict[str, str] = field(default_factory=dict)
    shown: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)

    def show(self, text: str) -> None:
        self.shown.append(text)

    def confirm(self, question: str) -> bool:
        return self._answer(question, "y") == "y"

    def text(self, question: str) -> str:
        return self._answer(question, "")

    def choose(self, question: str, options: Sequence[str], default: str = "") -> str:
        return self._answer(question, default)

    def _answer(self, question: str, default: str) -> str:
        self.asked.append(question)
        return next((answer for words, answer in self.answers.items() if words in question), default)


def guide(person: Person, *, has_panel: bool, has_tip: bool = True) -> Guide:
    kit: Any = SimpleNamespace(support=Support({}, {}))
    return Guide(kit, person, Path(), has_panel=has_panel, has_tip=has_tip)


# makers C3
@pytest.mark.parametrize(
    ("engaged", "current_a", "setpoint", "shown"),
    [
        (None, None, ("1e-10", "A"), None),
        (None, "9e-11", ("1e-10", "V"), None),
        (None, "4e-12", ("100", "pA"), None),
        (None, "-9e-11", ("100", "pA"), True),
        (None, "0", ("0", "A"), None),
        ("false", None, None, False),
        ("false", "9e-11", ("1e-10", "A"), True),
        ("true", "1e-15", ("1e-10", "A"), True),
    ],
)
def test_tip_is_at_the_sample_where_its_switch_or_its_current_shows_it(
    engaged: str | None, current_a: str | None, setpoint: tuple[str, str] | None, shown: bool | None
) -> None:
    read = {names.ENGAGED: (engaged, None), names.CURRENT: (current_a, "A"), names.ZCTRL_SETPOINT: setpoint}
    found, words = tip_shown({name: Parameter(name, *one) for name, one in read.items() if one and one[0]})
    assert found is shown
    assert ("x-engaged reads" in words) is (engaged is not None)


PANEL_QUESTIONS: dict[str, Callable[[Guide], object]] = {
    "has it stopped": lambda guide: guide.require_at_panel("has it stopped", "a panel that has stopped"),
    "press Enter": lambda guide: guide.at_panel("press Enter"),
    "which way": lambda guide: guide.require_choice("which way", "up", ["down"], "a frame"),
    "width": lambda guide: guide.compare("width", 1000.0, "nm"),
}


@pytest.mark.parametrize("words", PANEL_QUESTIONS)
def test_question_about_a_missing_panel_is_shown_and_not_asked(words: str) -> None:
    person = Person({words: "no"})
    assert not PANEL_QUESTIONS[words](guide(person, has_panel=False))
    assert not person.asked
    (line,) = person.shown
    assert line.startswith(f"  {words}")
    assert line.endswith("skipped: a simulated microscope has no panel")


@pytest.mark.parametrize("words", PANEL_QUESTIONS)
def test_question_about_a_panel_is_asked(words: str) -> None:
    person = Person()
    PANEL_QUESTIONS[words](guide(person, has_panel=True))
    assert [one.startswith(words) for one in person.asked] == [True]


def test_choice_without_an_answer_is_unseen_and_a_wrong_one_fails() -> None:
    ask = PANEL_QUESTIONS["which way"]
    assert ask(guide(Person(), has_panel=True)) is False
    assert ask(guide(Person({"which way": "up"}), has_panel=True)) is True
    with pytest.raises(Failed, match="down at the panel"):
        ask(guide(Person({"which way": "down"}), has_panel=True))
    assert UNSEEN == "unseen"


def test_unseen_outcome_is_skipped_with_a_panel_and_passes_without() -> None:
    with pytest.raises(Skipped, match="not seen at the panel"):
        guide(Person(), has_panel=True).unseen()
    assert "set and read back" in guide(Person(), has_panel=False).unseen()


def test_person_is_not_asked_about_the_tip_of_a_microscope_without_one() -> None:
    about_tip = [step for step in all_steps() if step.about_tip]
    person = Person()
    for step in about_tip:
        with pytest.raises(Unsupported, match="no tip"):
            guide(person, has_panel=True, has_tip=False).perform(step)
    assert len(about_tip) == 2
    assert not person.asked + person.shown
    assert guide(person, has_panel=True).perform(about_tip[0]).startswith("on your word alone")
    assert len(person.asked) == 1


# stmsim K8: asked for without end
@pytest.mark.parametrize(("typed", "says"), [("wide", "not understood: "), ("7 nm", "which is not 7 nm")])
def test_value_is_asked_for_a_limited_number_of_times(typed: str, says: str) -> None:
    person = Person({"Is 7 nm what the panel shows": "n", "width": typed})
    with pytest.raises(Skipped, match=r"width: none of 5 answers could be compared with 5 nm"):
        guide(person, has_panel=True).compare("width", 5.0, "nm")
    assert sum(says in line for line in (*person.shown, *person.asked)) == 5


def test_noise_of_a_translator_without_known_settings_is_skipped() -> None:
    (noise,) = [step for step in all_steps() if step.name == "noise"]
    with pytest.raises(Skipped, match="no setting of this translator is known"):
        guide(Person(), has_panel=True).perform(noise)
