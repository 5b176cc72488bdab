"""The trace of a controller: its exchanges and the files that it writes, as JSON lines.

One process communicates with one controller, so there is one trace in a process. `begin` opens it, and each vendor's
connection adds an exchange as one line. Without `begin` nothing is recorded. A connection leaves out its own secrets.
Printable text is written unchanged, other bytes in base64, so that a person can read the file.
"""

from __future__ import annotations

import base64
import json
import threading
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import IO, Final

from afspm.basics.clock import NS_PER_S, Clock, ExperimentClock
from afspm.basics.errors import FileError
from afspm.basics.formatting import counted, quantity
from afspm.basics.plain_data import Plain, from_json

FILE: Final = "controller.trace.jsonl"
FORMAT: Final = 1
_NEWEST_BYTES: Final = 1 << 20
TCP, ZEROMQ = "tcp", "zeromq"


@dataclass(frozen=True)
class TraceHeader:
    """The first line: the driver's class, the version of afspm, the experiment time (UTC in ISO 8601) and `FORMAT`."""

    driver: str
    afspm: str
    began: str
    trace: int = FORMAT


@dataclass(frozen=True)
class TracedExchange:
    """A question and its answer.

    Attributes:
        connection: the number of the connection, from 0.
        transport: `TCP` or `ZEROMQ`.
        what: the name of the question, for people.
        asked: the bytes of the question; None: a secret.
        answered: the bytes of the answer; incomplete or empty if there is a text in `lost`.
        after: number of lines in the file when the question was sent; the lines from there to this exchange belong to
            other connections and files.
        lost: the error that ended the exchange before the whole answer; empty for a whole answer.
        command: the request to which the exchange belongs; empty: the exchange only observes the controller.
        at_s, took_s: real seconds from the beginning to the question, and from the question to the answer.
    """

    connection: int
    transport: str
    what: str
    asked: bytes | None
    answered: bytes
    after: int
    lost: str = ""
    command: str = ""
    at_s: float = 0.0
    took_s: float = 0.0


@dataclass(frozen=True)
class TracedFile:
    """A file of the controller that was read, and its time of writing, in real seconds since the beginning."""

    file: str
    content: bytes
    at_s: float


TraceLine = TraceHeader | TracedExchange | TracedFile


@dataclass(frozen=True)
class ControllerLoad:
    """The load on a controller in a part of a trace, in real time.

    Attributes:
        most_in_a_second: the number of questions in the fullest second.
        answered_s: the median of the times to an answer; a question that waits for the end of a scan is one of many.
        lost: the number of questions without an answer.
    """

    connections: int
    questions_per_s: float
    over_s: float
    most_in_a_second: int
    answered_s: float
    lost: int

    def __str__(self) -> str:
        lost = f", {self.lost} without an answer" if self.lost else ""
        return (
            f"{counted(self.connections, 'connection')}, {self.questions_per_s:.3g} questions a second (at most"
            f" {self.most_in_a_second}), half of them answered within {quantity(self.answered_s, 's', 2)}{lost}"
        )


def read_trace(file: Path) -> list[TraceLine]:
    """Read a trace; an incomplete last line is left out. Raises as `trace_lines`."""
    return list(trace_lines(file))


def trace_lines(file: Path) -> Iterator[TraceLine]:
    """Yield the lines of a trace one by one: the trace of a night may be larger than memory.

    Raises:
        FileError: the file can't be read, is no trace, or is a trace of another version.
    """
    first = True
    try:
        with file.open(encoding="utf-8", newline="\n") as lines:
            for text in lines:
                if not text.endswith("\n"):
                    break  # of a killed process
                line = _line(from_json(text))
                if first and (not isinstance(line, TraceHeader) or line.trace != FORMAT):
                    break
                first = False
                yield line
    except (OSError, ValueError, TypeError, KeyError, zlib.error) as error:
        raise FileError(f"can't be read as a trace: {error}", where=str(file)) from error
    if first:
        raise FileError("is not a trace of this version of afspm", where=str(file), hint="afspm trace FILE records one")


def load_of(lines: Iterable[TraceLine]) -> ControllerLoad | None:
    """Return the load on the controller in a part of a trace; None if the part is too short."""
    # line by line: the trace of a night may be larger than memory
    connections, in_second, took_s, lost = set[int](), Counter[int](), list[float](), 0
    first_s, last_s = None, 0.0
    for line in lines:
        if isinstance(line, TracedExchange):
            first_s, last_s = line.at_s if first_s is None else first_s, line.at_s
            connections.add(line.connection)
            in_second[int(line.at_s)] += 1
            took_s.append(line.took_s)
            lost += bool(line.lost) and not line.answered  # a refusal by the controller is an answer
    if first_s is None or last_s <= first_s:
        return None
    over_s = last_s - first_s
    return ControllerLoad(
        connections=len(connections),
        questions_per_s=(len(took_s) - 1) / over_s,
        over_s=over_s,
        most_in_a_second=max(in_second.values()),
        answered_s=median(took_s),
        lost=lost,
    )


def newest_lines(file: Path) -> Iterator[TraceLine]:
    """Yield the last lines of a trace, some thousand at most; an incomplete line is left out. Raises OSError."""
    with file.open("rb") as stream:
        stream.seek(max(0, file.stat().st_size - _NEWEST_BYTES))
        parts = stream.read().split(b"\n")
    for part in parts[1:-1]:
        with suppress(ValueError, TypeError, KeyError, zlib.error):
            yield _line(from_json(part.decode()))


def written_line(line: TraceLine) -> str:
    """Return a line as it is written, without the line feed."""
    if isinstance(line, TracedFile):
        facts: Plain = {"file": line.file, "at_s": line.at_s, "zlib": _packed(line.content)}
    elif isinstance(line, TracedExchange):
        facts = {**asdict(line), "asked": _shown(line.asked), "answered": _shown(line.answered)}
        facts = {key: value for key, value in facts.items() if value or key not in ("lost", "command")}
    else:
        facts = asdict(line)
    return json.dumps(facts, ensure_ascii=False)


class Trace:
    """The trace of this process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._file: IO[str] | None = None
        self._clock: Clock | None = None
        self._began_s = self._began_at_s = 0.0
        self._lines = self._connections = 0
        self._command = ""
        self._files: set[tuple[Path, int]] = set()

    def begin(self, file: Path, header: TraceHeader, clock: Clock) -> None:
        """Record all exchanges from now on."""
        with self._lock:
            self._file, self._clock, self._began_s = file.open("w", encoding="utf-8"), clock, clock.monotonic_s()
            self._began_at_s = ExperimentClock.real().now_s()
            self._lines = self._connections = 0
            self._write(header)

    def end(self) -> None:
        """Stop recording."""
        with self._lock:
            if self._file is not None:
                self._file.close()
                self._file = None

    @property
    def is_kept(self) -> bool:
        return self._file is not None

    def connection(self, transport: str) -> TracedConnection:
        """Register a new connection, and return its recorder."""
        with self._lock:
            self._connections += 1
            return TracedConnection(self, self._connections - 1, transport)

    def command(self, request: str) -> None:
        """Assign all further exchanges to this request; empty: the exchanges only observe the controller."""
        self._command = request

    def file(self, path: Path) -> None:
        """Record a file of the controller, if it exists and is new or changed."""
        state = (path, path.stat().st_mtime_ns) if self.is_kept and path.is_file() else None
        if state is not None and state not in self._files:
            self._files.add(state)
            content = path.read_bytes()
            with self._lock:
                written_s = state[1] / NS_PER_S - self._began_at_s
                self._write(TracedFile(path.name, content, round(min(written_s, self.now_s()), 6)))

    @property
    def lines(self) -> int:
        return self._lines

    def now_s(self) -> float:
        """Return the real seconds since the beginning."""
        return 0.0 if self._clock is None else self._clock.monotonic_s() - self._began_s

    def exchange(self, one: TracedExchange) -> None:
        """Write a finished exchange."""
        with self._lock:
            self._write(replace(one, command=self._command))

    def _write(self, line: TraceLine) -> None:
        if self._file is not None:
            self._file.write(written_line(line) + "\n")
            self._file.flush()  # a killed process leaves all its exchanges
            self._lines += 1


class TracedConnection:
    """A recorder for one connection: `with connection.asking(name, message) as answer: answer.add(reply)`."""

    def __init__(self, trace: Trace, number: int, transport: str) -> None:
        self._trace = trace
        self._number = number
        self._transport = transport
        self._question: tuple[str, bytes | None, int, float] = ("", b"", 0, 0.0)

    def asked(self, what: str, content: bytes | None) -> None:
        """Record a question that is about to be sent; None: a secret."""
        self._question = (what, content, self._trace.lines, self._trace.now_s())

    @contextmanager
    def answering(self) -> Iterator[TracedAnswer]:
        """Record the answer to the last question, or its error, at the end of the `with` block."""
        answer = TracedAnswer(is_kept=self._trace.is_kept)
        lost = ""
        try:
            yield answer
        except BaseException as error:  # raised again; the trace shows any end of an exchange, also an interruption
            lost = "" if answer.is_whole else f"{type(error).__name__}: {error}"
            raise
        finally:
            if answer.is_kept:
                self._write(bytes(answer.content), lost)

    @contextmanager
    def failing(self) -> Iterator[None]:
        """Record that the last question could not be sent if the `with` block raises."""
        try:
            yield
        except BaseException as error:  # raised again; the trace shows any end of an exchange, also an interruption
            self._write(b"", f"{type(error).__name__}: {error}")
            raise

    @contextmanager
    def asking(self, what: str, content: bytes | None) -> Iterator[TracedAnswer]:
        """Combine `asked` and `answering`, for a question that is sent and answered in one block."""
        self.asked(what, content)
        with self.answering() as answer:
            yield answer

    def _write(self, content: bytes, lost: str) -> None:
        what, asked, after, at_s = self._question
        took_s = round(self._trace.now_s() - at_s, 6)
        where = (self._number, self._transport, what)
        self._trace.exchange(TracedExchange(*where, asked, content, after, lost, at_s=round(at_s, 6), took_s=took_s))


class TracedAnswer:
    """The bytes of an answer, as they arrive.

    Attributes:
        is_whole: the answer has arrived completely, valid or not.
    """

    def __init__(self, *, is_kept: bool) -> None:
        self.is_kept = is_kept
        self.is_whole = False
        self.content = bytearray()

    def add(self, part: bytes) -> None:
        if self.is_kept:
            self.content += part


TRACE: Final = Trace()


def _packed(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content)).decode()


def _shown(content: bytes | None) -> object:
    if content is None:
        return None
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = ""
    readable = text.replace("\n", "").replace("\t", "").isprintable() and bool(text)
    return text if readable or not content else {"base64": base64.b64encode(content).decode()}


def _content(shown: object) -> bytes | None:
    if isinstance(shown, dict):
        return base64.b64decode(shown["base64"], validate=True)
    return None if shown is None else str(shown).encode()


def _line(facts: Plain) -> TraceLine:
    if "trace" in facts:
        return TraceHeader(**facts)
    if "file" in facts:
        content = zlib.decompress(base64.b64decode(facts["zlib"], validate=True))
        return TracedFile(facts["file"], content, facts["at_s"])
    return TracedExchange(
        **{**facts, "asked": _content(facts["asked"]), "answered": _content(facts["answered"]) or b""}
    )
