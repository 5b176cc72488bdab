"""GXSM's Python console: runs a user's script in a thread; GXSM executes its calls one at a time."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Final

SCRIPT: Final = Path(__file__).parents[1] / "bridge.py"
"""The default script, executed from its file as in GXSM's console, instead of imported."""
_LISTENS: Final = re.compile(r"listening at (\S+):(\d+)")


class ConsoleClosed(BaseException):
    """The error that ends a script when GXSM is closed; `except Exception` in the script does not catch this error."""


@dataclass(frozen=True, eq=False)
class ScriptCall:
    """A call of a GXSM function.

    Attributes:
        answered: receives the result, or the exception to raise.
    """

    method: str
    arguments: tuple[object, ...]
    answered: Callable[[object], None]


class GxsmModule:
    """The object that a console script uses as the module `gxsm`. Each attribute is a function of GXSM.

    A call is posted to the emulator; the script's thread waits for the result.

    Args:
        post: receives the calls, from the script's thread.
    """

    def __init__(self, post: Callable[[ScriptCall], None]) -> None:
        self._post = post
        self._waiting: set[Future[object]] = set()
        self._gone = False

    def __getattr__(self, method: str) -> Callable[..., object]:
        def call(*arguments: object) -> object:
            answer: Future[object] = Future()
            self._waiting.add(answer)
            if self._gone:
                raise ConsoleClosed
            self._post(ScriptCall(method, arguments, answer.set_result))
            found = answer.result()
            self._waiting.discard(answer)
            if isinstance(found, BaseException):
                raise found
            return found

        return call

    def end(self) -> None:
        """Raise `ConsoleClosed` in every call that waits for its answer, and in all later calls."""
        self._gone = True
        for answer in list(self._waiting):
            if not answer.done():
                answer.set_result(ConsoleClosed())


class ScriptConsole:
    """A console that runs a script.

    Args:
        script: path of a script that listens at a port, and prints the address.
        port: the script's variable `PORT`; 0: any free port.
        folder: folder in which GXSM was started, the script's variable `FOLDER`.
        post: receives the script's calls, from its thread.
        ended: called from the script's thread when the script has ended.
    """

    def __init__(
        self, script: Path, port: int, folder: Path, post: Callable[[ScriptCall], None], ended: Callable[[], None]
    ) -> None:
        self._module = GxsmModule(post)
        self._address: Future[str] = Future()
        self._script, self._port, self._folder, self._ended = script, port, folder, ended
        self._runs = True
        self._thread = threading.Thread(target=self._run, daemon=True, name="GXSM's console")
        self._thread.start()

    def poll(self) -> str | None:
        """Return the address at which the script listens; None until the script has printed the address.

        Raises:
            the exception that ended the script before the script had printed its address.
        """
        return self._address.result() if self._address.done() else None

    @property
    def runs(self) -> bool:
        return self._runs

    def end(self) -> None:
        self._module.end()
        self._thread.join()

    def _run(self) -> None:
        def print_(*values: object) -> None:
            found = _LISTENS.search(" ".join(map(str, values)))
            if found and not self._address.done():
                self._address.set_result(f"{found[1]}:{found[2]}")

        scope = {
            "__name__": "__main__",
            "gxsm": self._module,
            "PORT": self._port,
            "FOLDER": str(self._folder),
            "print": print_,
        }
        try:
            exec(compile(self._script.read_text(encoding="utf-8"), str(self._script), "exec"), scope)
        except ConsoleClosed:
            pass
        except BaseException as error:  # SystemExit, too: `poll` raises it in the emulator's thread
            if not self._address.done():
                self._address.set_exception(error)
        finally:
            self._runs = False
            self._ended()
