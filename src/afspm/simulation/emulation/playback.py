"""Playback of a trace: the answer to each question, and the first difference from the recording. Pure.

A request (`TracedExchange.command`) must be repeated as it was recorded, in the same order. A read of the controller
may be repeated more or less often and in another order: its frequency depends on timing. Request ids of the client are
not compared, and secrets are left out: they differ each time. Comparing all bytes in order would fail at once;
answering each question by its newest answer would accept a translator that starts a scan before it has set the frame.
The trace is made at the connection and not at the driver, since drivers are mostly wrong in reading answers.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from afspm.basics.plain_data import Plain, from_json
from afspm.translator.trace import TracedExchange, TracedFile, TraceLine

_IDS: Final = ("messageID", "id")
_SHOWN: Final = 200


class Deviation(Exception):
    """The error that the client differs from the recording; its text gives the line and both requests."""


@dataclass(frozen=True)
class PlayedAnswer:
    """A recorded answer.

    Attributes:
        line: line of the trace, from 1.
        content: None if the connection was lost here.
    """

    line: int
    content: bytes | None


@dataclass
class _Cursor:
    """The progress of one connection: the index of its next exchange among its own."""

    exchanges: Sequence[tuple[int, TracedExchange]]
    next: int = 0


class Playback:
    """The progress of a playback.

    Args:
        lines: the lines of the trace (`read_trace`).
    """

    def __init__(self, lines: Sequence[TraceLine]) -> None:
        exchanges = [(number, line) for number, line in enumerate(lines, 1) if isinstance(line, TracedExchange)]
        numbered = [(number, line) for number, line in exchanges if line.asked is not None]
        self._files = [(number, line) for number, line in enumerate(lines, 1) if isinstance(line, TracedFile)]
        connections = sorted({exchange.connection for _, exchange in exchanges})
        self._recorded = [[entry for entry in numbered if entry[1].connection == number] for number in connections]
        self._looks = {_compared(exchange.asked) for _, exchange in numbered if not exchange.command}
        self._cursors: list[_Cursor] = []
        self._last_line = numbered[-1][0] if numbered else 0
        self._reached = 0

    @property
    def transport(self) -> str:
        """The transport of the recorded controller; empty without exchanges."""
        return next((entry[1].transport for exchanges in self._recorded for entry in exchanges), "")

    @property
    def missing(self) -> list[tuple[int, TracedExchange]]:
        """The recorded exchanges of requests that have not been repeated, with their lines."""
        begun = [entry for cursor in self._cursors for entry in cursor.exchanges[cursor.next :]]
        unopened = [entry for exchanges in self._recorded[len(self._cursors) :] for entry in exchanges]
        return [entry for entry in begun + unopened if entry[1].command]

    def connect(self) -> int:
        """Register a new connection; return its number."""
        number = len(self._cursors)
        self._cursors.append(_Cursor(self._recorded[number] if number < len(self._recorded) else []))
        return number

    def ask(self, connection: int, content: bytes) -> PlayedAnswer | None:
        """Return the answer to a request; None if the answer is due later, or the request or recording is incomplete.

        Raises:
            Deviation: the recording differs.
        """
        cursor = self._cursors[connection]
        match = self._match(cursor, content)
        if match is None:
            if self._may_continue(cursor, content):
                return None
            raise Deviation(self._difference(cursor, content))
        index, (line, exchange) = match
        if index >= cursor.next:
            self._reached = max(self._reached, _line_before(cursor, index))
            if exchange.after < line - 1 and not self._has_passed(connection, exchange.after, line):
                return None
            if exchange.lost and line == self._last_line:
                return None  # cut by the end of the recording, not by the controller
            cursor.next = index + 1
            self._reached = max(self._reached, line)
        if exchange.lost and not exchange.answered:
            return PlayedAnswer(line, None)
        return PlayedAnswer(line, _with_ids_of(content, exchange.answered))

    def files(self) -> list[TracedFile]:
        """Return the files that the recorded controller wrote since the last call."""
        due = [file for file in self._files if self._last_before(*file) <= self._reached]
        self._files = [file for file in self._files if file not in due]
        return [file for _, file in due]

    def _last_before(self, line: int, file: TracedFile) -> int:
        entries = [entry for exchanges in self._recorded for entry in exchanges]
        return max(
            (number for number, exchange in entries if number < line and exchange.at_s + exchange.took_s <= file.at_s),
            default=0,
        )

    def _has_passed(self, connection: int, after: int, line: int) -> bool:
        # the order between connections is part of the recording
        others = [cursor for number, cursor in enumerate(self._cursors) if number != connection]
        meanwhile = [number for cursor in others for number, _ in cursor.exchanges if after < number < line]
        return not meanwhile or self._reached >= max(meanwhile)

    def _match(self, cursor: _Cursor, content: bytes) -> tuple[int, tuple[int, TracedExchange]] | None:
        # the next recorded exchange, skipping reads; otherwise an earlier answer to the same read: a client may read
        # more or less often than it did in the recording
        exchanges, wanted = cursor.exchanges, _compared(content)
        for index in range(cursor.next, len(exchanges)):
            exchange = exchanges[index][1]
            if _compared(exchange.asked) == wanted:
                return index, exchanges[index]
            if _compared(exchange.asked) not in self._looks:
                break
        if wanted in self._looks:
            for index in [*range(cursor.next - 1, -1, -1), *range(cursor.next, len(exchanges))]:
                if _compared(exchanges[index][1].asked) == wanted and (
                    index < cursor.next or not exchanges[index][1].command
                ):
                    return min(index, cursor.next - 1), exchanges[index]
        return None

    def _may_continue(self, cursor: _Cursor, content: bytes) -> bool:
        rest = cursor.exchanges[cursor.next :]
        questions = {
            exchange.asked for _, exchange in cursor.exchanges if exchange.asked is not None and not exchange.command
        }
        questions |= {exchange.asked for _, exchange in rest if exchange.asked is not None}
        return any(asked != content and asked.startswith(content) for asked in questions)

    def _difference(self, cursor: _Cursor, content: bytes) -> str:
        left = cursor.exchanges[cursor.next :]
        rest = [entry for entry in left if _compared(entry[1].asked or b"") not in self._looks]
        if not rest:
            return f"after line {self._reached}: asked {_shown(content)}, and no request was recorded any more"
        line, exchange = rest[0]
        recorded = f"{exchange.what} {_shown(exchange.asked or b'')} (of {exchange.command or 'no request'})"
        return f"line {line}: recorded {recorded}; asked {_shown(content)}"


def _line_before(cursor: _Cursor, index: int) -> int:
    # the client is past it, though it may have read less often
    return cursor.exchanges[index - 1][0] if index else 0


def _compared(asked: bytes | None) -> bytes:
    # without the ids that a client gives its requests
    request = _json(asked or b"")
    if request is None or not any(key in request for key in _IDS):
        return asked or b""
    return json.dumps({key: value for key, value in request.items() if key not in _IDS}, sort_keys=True).encode()


def _with_ids_of(asked: bytes, answer: bytes) -> bytes:
    question, reply = _json(asked), _json(answer)
    if question is None or reply is None:
        return answer
    ids = {key: question[key] for key in _IDS if key in question and key in reply}
    return json.dumps({**reply, **ids}).encode() if ids else answer


def _json(content: bytes) -> Plain | None:
    if not content.startswith(b"{"):
        return None
    try:
        value = from_json(content)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None


def _shown(content: bytes) -> str:
    text = content.decode("utf-8", "backslashreplace").replace("\0", "")
    return repr(text[:_SHOWN])
