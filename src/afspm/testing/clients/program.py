"""The conformance program of a client as a process, with steps on standard input and answers on standard output."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any, Protocol

from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch
from afspm.basics.plain_data import Plain
from afspm.testing.conformance import Failed, expect

ANSWER_S = 30.0
"""Longest time for an answer, in addition to the step's own wait."""
_LAST_WORDS = 3


class Pump(Protocol):
    """The function that processes the judge's own sockets while waiting for the client."""

    def __call__(self, done: Callable[[], bool], within_s: float) -> bool:
        """Wait until `done()`; return False on a timeout."""
        ...


class Answer(Plain):
    @property
    def ok(self) -> bool:
        return self.get("ok") is True

    def __str__(self) -> str:
        facts = {key: value for key, value in self.items() if key != "id"}
        text = json.dumps(facts, ensure_ascii=False)
        return text if len(text) < 400 else f"{text[:400]} …"


class ClientProgram:
    """A running conformance program.

    Args:
        command: the program and its arguments.
        launch: the client's launch line.
        pump: waits for the program's answers.
        wake: called from other threads after output of the program, and after its end.
        log: the file for the program's standard error.

    Raises:
        ConfigError: the program can't be started.
    """

    def __init__(self, command: Sequence[str], launch: Launch, pump: Pump, wake: Callable[[], None], log: Path) -> None:
        self.launch = launch
        self._pump, self._wake = pump, wake
        self._answers: dict[int, Answer] = {}
        self._garbage: deque[str] = deque(maxlen=_LAST_WORDS)
        self._stderr_lines: deque[str] = deque(maxlen=_LAST_WORDS)
        self._begun: dict[int, str] = {}
        self._next = 0
        self._log = log
        try:
            self._popen = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                # its own process group, so that `kill` reaches its children
                start_new_session=sys.platform != "win32",
            )
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{command[0]} can't be started: {error}", hint="afspm test-client -- COMMAND ARGUMENTS…"
            ) from error
        self.pid = self._popen.pid
        self._threads = [
            threading.Thread(target=self._read, args=(self._popen.stdout, self._take), daemon=True),
            threading.Thread(target=self._read, args=(self._popen.stderr, self._note), daemon=True),
        ]
        for thread in self._threads:
            thread.start()
        self._write(launch.to_json())

    # --- steps ---

    def begin(self, do: str, **arguments: object) -> int:
        """Send a step, and return its id."""
        self._next += 1
        self._begun[self._next] = do
        self._write(json.dumps({"id": self._next, "do": do, **arguments}))
        return self._next

    def answer(self, step: int, within_s: float = ANSWER_S) -> Answer:
        """Return the answer to a step.

        Raises:
            Failed: no answer arrives, or the output is no valid answer.
        """
        self._pump(lambda: step in self._answers or not self.is_running, within_s)
        self._finish_reading()
        if step in self._answers:
            return self._answers.pop(step)
        came = f"nothing in {within_s:.0f} s" if self.is_running else f"the end of the program ({self.ending})"
        raise Failed(f"an answer to the step {self._begun[step]}", f"{came}{self.last_words}")

    def is_answered(self, step: int) -> bool:
        return step in self._answers

    def do(self, do: str, **arguments: object) -> Answer:
        """Send a step, and return the answer.

        Raises:
            Failed: no answer arrives, or the answer is an error.
        """
        answer = self.do_quietly(do, **arguments)
        expect("error" not in answer, f"the step {do} to be done", str(answer))
        return answer

    def do_quietly(self, do: str, **arguments: Any) -> Answer:
        """Send a step, and return the answer, even an error.

        Raises:
            Failed: no answer arrives.
        """
        return self.answer(self.begin(do, **arguments), ANSWER_S + float(arguments.get("timeout_s", 0.0)))

    def succeed(self, do: str, **arguments: object) -> Answer:
        """Send a step that must succeed. Raises Failed."""
        answer = self.do(do, **arguments)
        expect(answer.ok, f"the step {do} to succeed", str(answer))
        return answer

    # --- its end ---

    @property
    def is_running(self) -> bool:
        return self._popen.poll() is None

    @property
    def ending(self) -> str:
        """The end of the program in words: its exit code or signal, or "still running"."""
        code = self._popen.poll()
        return "still running" if code is None else f"exit code {code}" if code >= 0 else f"signal {-code}"

    @property
    def exit_code(self) -> int | None:
        return self._popen.poll()

    @property
    def last_words(self) -> str:
        """The last lines on standard error, and invalid lines on standard output; empty if there are none."""
        lines = [*self._garbage, *self._stderr_lines]
        return f"; its last lines: {' / '.join(lines)}" if lines else ""

    def close_stdin(self) -> None:
        """Close the program's standard input, which requests its end."""
        assert self._popen.stdin is not None
        with contextlib.suppress(OSError):
            self._popen.stdin.close()

    def wait_ended(self, within_s: float) -> bool:
        """Wait until the program has ended; return False on a timeout."""
        return self._pump(lambda: not self.is_running, within_s)

    def kill(self) -> None:
        """Kill the program with its child processes."""
        if sys.platform == "win32":
            self._popen.kill()
        else:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)
        self._popen.wait()
        self.close_stdin()
        self._finish_reading()

    def require_clean_output(self) -> None:
        """Raise Failed if standard output contained any line except answers."""
        expect(not self._garbage, "only answers on standard output", " / ".join(self._garbage))

    # --- lines ---

    def _write(self, line: str) -> None:
        assert self._popen.stdin is not None
        with contextlib.suppress(OSError):  # it has ended, which the wait for the answer reports
            self._popen.stdin.write(line.encode() + b"\n")
            self._popen.stdin.flush()

    def _read(self, pipe: IO[bytes], take: Callable[[str], None]) -> None:
        with contextlib.suppress(OSError, ValueError), pipe:
            for line in pipe:
                take(line.decode(errors="replace").rstrip())
                self._wake()
        self._popen.wait()
        self._wake()

    def _take(self, line: str) -> None:
        try:
            answer = Answer(json.loads(line))
            self._answers[int(answer["id"])] = answer
        except (ValueError, TypeError, KeyError):
            # kept as evidence for `require_clean_output`
            self._garbage.append(line[:200])

    def _note(self, line: str) -> None:
        self._stderr_lines.append(line[:300])
        with self._log.open("a", encoding="utf-8") as file:
            file.write(f"{self.pid} {line}\n")

    def _finish_reading(self) -> None:
        if not self.is_running:
            for thread in self._threads:
                thread.join(1.0)
