"""A trace played back to a client whose connections take another time than they took."""

from __future__ import annotations

from afspm.simulation.emulation.playback import Playback, PlayedAnswer
from afspm.translator.trace import TracedExchange


def look(connection: int, asked: bytes, after: int, lost: str = "") -> TracedExchange:
    return TracedExchange(connection, "tcp", "", asked, b"" if lost else asked.upper(), after, lost)


def test_a_client_that_looks_less_often_keeps_no_other_connection_waiting() -> None:
    """The second waits for the end of the scan, and is told of it after the last look of the first."""
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


def test_what_was_under_way_when_the_recording_ended_is_not_lost_again() -> None:
    """It would be far too early for a client that has yet to ask for what is left."""
    played = Playback([look(0, b"first", 0), look(0, b"state", 1), look(1, b"end", 2, lost="closed")])
    one, other = played.connect(), played.connect()
    assert played.ask(one, b"state") == PlayedAnswer(2, b"STATE")
    assert played.ask(other, b"end") is None
    assert played.ask(one, b"first") == PlayedAnswer(1, b"FIRST")


def test_what_the_controller_did_not_answer_is_lost_again() -> None:
    played = Playback([look(0, b"first", 0, lost="closed"), look(1, b"first", 1)])
    assert played.ask(played.connect(), b"first") == PlayedAnswer(1, None)
    assert played.ask(played.connect(), b"first") == PlayedAnswer(2, b"FIRST")
