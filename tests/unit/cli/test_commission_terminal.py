"""Questions of `afspm commission` in the terminal: an invalid answer is refused, a limited number of times."""

from __future__ import annotations

import builtins
from collections.abc import Iterator

import pytest

from afspm.cli.commission import Terminal

WAYS = ["up", "down", "unseen"]


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Type these lines in order; then the input ends."""
    lines: list[str] = []

    def line(prompt: str) -> str:
        if not lines:
            raise EOFError
        return lines.pop(0)

    monkeypatch.setattr(builtins, "input", line)
    yield lines
    assert not lines, "more was typed than was asked"


@pytest.mark.parametrize(
    ("line", "chosen"), [("2", "down"), ("down", "down"), (" Up ", "up"), ("d", "down"), ("", "unseen")]
)
def test_option_is_chosen_by_number_by_word_by_its_beginning_or_by_enter(
    typed: list[str], line: str, chosen: str
) -> None:
    typed.append(line)
    assert Terminal().choose("Where to?", WAYS, "unseen") == chosen


@pytest.mark.parametrize("wrong", ["4", "0", "²", "sideways", "-1", "u"])
def test_invalid_choice_is_refused_in_words_and_asked_again(
    typed: list[str], wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    typed += [wrong, "1"]
    assert Terminal().choose("Where to?", WAYS, "unseen") == "up"
    assert f"{wrong!r} is none of them: type a number from 1 to 3, or the word" in capsys.readouterr().out


def test_choice_without_a_default_ends_after_a_few_empty_answers(
    typed: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    typed += [""] * 5
    with pytest.raises(KeyboardInterrupt):
        Terminal().choose("What is connected?", ["instrument", "maker's program"])
    assert "no choice after 5 answers: ended" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("lines", "confirmed"), [(["y"], True), ([""], False), (["1", "Yes"], True), (["1"] * 5, False), (["no"], False)]
)
def test_answer_that_is_neither_yes_nor_no_is_asked_for_again(
    typed: list[str], lines: list[str], confirmed: bool
) -> None:
    typed += lines
    assert Terminal().confirm("Shall afspm do this now?") is confirmed
