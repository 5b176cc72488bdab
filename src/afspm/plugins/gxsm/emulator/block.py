"""The owner side of Gxsm4's shared memory, which passes calls of other programs to the emulator."""

from __future__ import annotations

import contextlib
import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from afspm.basics import ConfigError
from afspm.emulation import Crashed, Faults
from afspm.plugins.gxsm import pickles
from afspm.plugins.gxsm.emulator.console import ScriptCall
from afspm.plugins.gxsm.emulator.signalled import CONTENT, SIZE
from afspm.plugins.gxsm.errors import BadReply

FAULT_KINDS: Final[Mapping[str, str]] = {
    "bad-pickle": "shared memory: the result is not a pickle",
    "evil-pickle": "shared memory: the result would run a program if it were unpickled",
    "code": "shared memory: the status -1, as for a result that can't be passed on",
    "huge": "shared memory: a result that is longer than the memory",
}
NAME_BYTES: Final = 64
_NO_SUCH_FUNCTION, _NOT_PASSED_ON = -4, -1


class SharedMemoryBlock:
    """The shared memory with its serving process. Call `take` when `fileno` is readable.

    Args:
        name: name of the memory.
        process: name that the process gives itself.
        folder: folder in which the process starts.
        post: receives the calls.

    Raises:
        ConfigError: the system is not Linux.
    """

    def __init__(
        self,
        name: str,
        process: str,
        folder: Path,
        faults: Faults,
        now_s: Callable[[], float],
        post: Callable[[ScriptCall], None],
    ) -> None:
        if not sys.platform.startswith("linux"):
            raise ConfigError("Gxsm4's shared memory is there on Linux alone", where="transport", hint='"bridge"')
        self._name, self._faults, self._now_s, self._post = name, faults, now_s, post
        command = [sys.executable, "-I", "-S", str(Path(__file__).with_name("signalled.py")), name, process]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=folder)
        self._frame()  # the first frame: the process is ready for signals

    @property
    def pid(self) -> int:
        """Id of the process that receives the signals."""
        return self._process.pid

    def fileno(self) -> int:
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def take(self) -> None:
        """Post a received call; answer malformed arguments with an error.

        Raises:
            Crashed: the process was killed.
        """
        frame = self._frame()
        if not frame:
            raise Crashed("its process is gone")
        method = frame[:NAME_BYTES].split(b"\0", 1)[0].decode("latin-1")
        try:
            arguments = pickles.loads(frame[NAME_BYTES:])
        except BadReply as error:
            self._answer(error)
            return
        self._post(ScriptCall(method, arguments if isinstance(arguments, tuple) else (arguments,), self._answer))

    def end(self, *, remains: bool = False) -> None:
        """End the process.

        Args:
            remains: True leaves the memory in place, as the real program does.
        """
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
        if not remains:
            Path("/dev/shm", self._name).unlink(missing_ok=True)

    def _frame(self) -> bytes:
        assert self._process.stdout is not None
        head = self._process.stdout.read(4)
        if len(head) < 4:
            return b""
        return self._process.stdout.read(struct.unpack(">I", head)[0])

    def _answer(self, found: object) -> None:
        now_s = self._now_s()
        status, content = 0, b""
        if isinstance(found, NameError):
            status = _NO_SUCH_FUNCTION
        elif isinstance(found, BaseException):
            status = _NOT_PASSED_ON
        else:
            try:
                content = pickle.dumps(found, 4)
            except Exception:  # pickle raises any error of an object's own code
                status = _NOT_PASSED_ON
        if len(content) > SIZE - CONTENT:
            status, content = _NOT_PASSED_ON, b""
        length = len(content)
        if self._faults.strikes("code", now_s):
            status = _NOT_PASSED_ON
        if self._faults.strikes("bad-pickle", now_s):
            content = bytes(range(255, 255 - length, -1)) if length < 255 else content[: length // 2]
        if self._faults.strikes("evil-pickle", now_s):
            content = pickle.dumps(_MaliciousPickle(), 4)
            length = len(content)
        if self._faults.strikes("huge", now_s):
            length = 1 << 31
        self._write(struct.pack("<qQ", status, length) + content)

    def _write(self, answer: bytes) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # the process was killed
            self._process.stdin.write(struct.pack(">I", len(answer)) + answer)
            self._process.stdin.flush()


class _MaliciousPickle:
    """An object whose pickle makes an unrestricted unpickler create a folder `evil`."""

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, ("evil",)
