"""JavaScript scripts, each in a separate engine, that wait for the instrument without blocking others.

A script can't be suspended inside an engine, so each engine has a thread. The emulator's own thread executes the
requests of a script to the instrument, and takes turns with the script's thread.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event, Thread
from typing import Final

from afspm.basics import AfspmError
from afspm.emulation import ScriptFailed

LONGEST_S: Final = 5.0
"""Limit of a script's computing between two requests to the instrument, in real seconds.

The script's thread continues: the engine can't be interrupted."""
MOST_ALONE: Final = 20
"""Requests that a script may still send to the instrument once its client has gone: enough for a withdrawal."""
_MEMORY: Final = 64 << 20
_PRELUDE: Final = Path(__file__).with_name("prelude.js")
_REFUSALS: Final = (AfspmError, ArithmeticError, TypeError, ValueError)
_END: Final = json.dumps({"error": "the script was ended"})


@dataclass(frozen=True)
class Wait:
    """The result of a long method: the script waits until `waiting` is false, then gets the value."""

    waiting: Callable[[], bool]
    value: Callable[[], object] = lambda: None


Ask = Callable[[str, str, list[object]], object]
"""A function that executes a script's request: "get", "set" or "call", a path below `spm`, and the arguments.

The request "now" returns the time of the controller's clock in ms. Raises AfspmError."""


class Script:
    """A running script.

    Args:
        names: the "values" and "methods" of `spm`.
        wake: called from the script's thread when `step` has more to do.
        is_alone: returns whether the script's client has gone.
        at_once_s: longest turn before other clients are served, in real seconds; most scripts end earlier.
        longest_s: limit of computing between two requests to the instrument, in real seconds.
    """

    def __init__(
        self,
        source: str,
        names: str,
        ask: Ask,
        wake: Callable[[], None] = lambda: None,
        is_alone: Callable[[], bool] = lambda: False,
        *,
        at_once_s: float = 0.25,
        longest_s: float = LONGEST_S,
    ) -> None:
        self._at_once_s, self._longest_s = at_once_s, longest_s
        self._ask, self._wake, self._is_alone = ask, wake, is_alone
        self._asked_alone = 0
        self._computes_since_s = time.monotonic()
        self._asks: SimpleQueue[tuple[str, str]] = SimpleQueue()
        self._answers: SimpleQueue[str] = SimpleQueue()
        self._wait: Wait | None = None
        self._ended = self._was_refused = False
        Thread(target=self._work, args=(source, names), name="emulated script", daemon=True).start()

    def step(self) -> tuple[object, str] | None:
        """Continue the script; return its value and text, or None while the script waits or computes.

        Raises:
            ScriptFailed: the script failed, computed longer than `longest_s`, or goes on although its client has gone.
        """
        until_s = time.monotonic() + self._at_once_s
        if self._wait is not None:
            if self._wait.waiting():
                return None
            ended, self._wait = self._wait, None
            self._answer(ended)
        while True:
            try:
                kind, content = self._asks.get(timeout=max(until_s - time.monotonic(), 0.0))
            except Empty:
                if self.computes_for_s > 0.0:
                    return None
                self.end()
                raise ScriptFailed("the script does not come to an end") from None
            if kind == "failed":
                raise ScriptFailed(content)
            if kind == "done":
                value, text = json.loads(content)
                return value, text
            if self._is_alone():
                self._asked_alone += 1
            if self._asked_alone > MOST_ALONE:
                self.end()
                raise ScriptFailed("its client has gone, and the script does not come to an end")
            # a script that sends one request after the other gets a turn like the others: its next request wakes
            if not self._answered(content) or time.monotonic() >= until_s:
                return None

    @property
    def waits(self) -> bool:
        return self._wait is not None

    @property
    def computes_for_s(self) -> float:
        """The real seconds of computing left to the script; infinity while the script waits for the instrument."""
        return math.inf if self.waits else self._computes_since_s + self._longest_s - time.monotonic()

    def end(self) -> None:
        """End the script: all its further requests fail."""
        self._ended, self._wait = True, None
        self._answers.put(_END)

    def _answered(self, content: str) -> bool:
        self._computes_since_s = time.monotonic()
        try:
            found = self._ask(*json.loads(content))
        except _REFUSALS as error:
            self._answers.put(json.dumps({"error": str(error)}))
            return True
        wait = found if isinstance(found, Wait) else Wait(lambda: False, lambda: found)
        if wait.waiting():
            self._wait = wait
            return False
        self._answer(wait)
        return True

    def _answer(self, wait: Wait) -> None:
        self._computes_since_s = time.monotonic()
        try:
            self._answers.put(json.dumps({"value": wait.value()}))
        except _REFUSALS as error:
            self._answers.put(json.dumps({"error": str(error)}))

    # -- in the script's thread

    def _work(self, source: str, names: str) -> None:
        import quickjs

        try:
            context = quickjs.Context()
            context.set_memory_limit(_MEMORY)
            context.set("__names", names)
            context.add_callable("__ask", self._asked)
            context.eval(_PRELUDE.read_text(encoding="utf-8"))
            context.set("__source", source)
            self._hand_over("done", context.eval("__run(__source)"))
        # any other failure of the engine must end its script, too: the emulator waits for it
        except Exception as error:
            self._hand_over("failed", str(error).partition("\n")[0])

    def _asked(self, content: str) -> str:
        # Never raises: the engine would not survive it.
        if self._ended and self._was_refused:
            Event().wait()  # for ever: a script that catches the error and asks again would keep a processor busy
        if self._ended:
            self._was_refused = True
            return _END
        self._hand_over("ask", content)
        return self._answers.get()

    def _hand_over(self, kind: str, content: str) -> None:
        self._asks.put((kind, content))
        self._wake()
