"""The load on a controller, from the trace of its questions."""

from __future__ import annotations

from afspm.translator.trace import TCP, TracedExchange, load_of


def asked(at_s: float, *, connection: int = 0, lost: str = "", took_s: float = 0.002) -> TracedExchange:
    return TracedExchange(connection, TCP, "Bias.Get", b"?", b"" if lost else b"!", 0, lost, at_s=at_s, took_s=took_s)


def test_load_has_rate_fullest_second_and_time_of_answers() -> None:
    lines = [*(asked(part / 8) for part in range(9)), asked(3.0, connection=1, took_s=2.5, lost="timeout")]
    found = load_of(lines)
    assert found is not None
    assert (found.questions_per_s, found.over_s, found.most_in_a_second) == (3.0, 3.0, 8)
    assert str(found) == (
        "2 connections, 3 questions a second (at most 8), half of them answered within 2 ms, 1 without an answer"
    )


def test_single_question_is_no_load() -> None:
    assert load_of([asked(1.0)]) is None
