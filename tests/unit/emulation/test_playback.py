"""A trace played back to a client whose connections have another timing."""

from __future__ import annotations

from afspm.simulation.emulation.playback import Playback, PlayedAnswer
from afspm.translator.trace import TracedExchange


def look(connection: int, asked: bytes, after: int, lost: str = "") -> TracedExchange:
    return TracedExchange(connection, "tcp", "", asked, b"" if lost else asked.upper(), after, lost)


def test_client_that_reads_less_often_delays_no_other_connection() -> None:
    # the second connection waits for the end of the scan, which follows the last read of the first
    played = Playback(
        [
            look(0, b"first", 0),
            look(0, b"state", 1),
            look(0, b"state", 2),
            look(1, b"end", 1),
            look(0, b"last", 3),
        ]
    )
    one, other = played.connect(), played.connect()
    assert played.ask(one, b"first") == PlayedAnswer(1, b"FIRST")
    assert played.ask(other, b"end") is None
    assert played.ask(one, b"last") is None  # without a look at the state
    assert played.ask(other, b"end") == PlayedAnswer(4, b"END")
    assert played.ask(one, b"last") == PlayedAnswer(5, b"LAST")


def test_exchange_unfinished_at_the_end_of_the_recording_is_not_cut() -> None:
    # too early for a client that has yet to send its remaining requests
    played = Playback([look(0, b"first", 0), look(0, b"state", 1), look(1, b"end", 2, lost="closed")])
    one, other = played.connect(), played.connect()
    assert played.ask(one, b"state") == PlayedAnswer(2, b"STATE")
    assert played.ask(other, b"end") is None
    assert played.ask(one, b"first") == PlayedAnswer(1, b"FIRST")


def test_unanswered_question_is_unanswered_again() -> None:
    played = Playback([look(0, b"first", 0, lost="closed"), look(1, b"first", 1)])
    assert played.ask(played.connect(), b"first") == PlayedAnswer(1, None)
    assert played.ask(played.connect(), b"first") == PlayedAnswer(2, b"FIRST")
