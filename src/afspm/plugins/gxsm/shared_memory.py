"""Link to Gxsm4 through its shared memory for other programs of the same user (Linux).

A call is written into the block and announced by a signal; the answer appears in the block. A caller holds the lock
that GXSM's own tools also take: two callers at once would receive each other's answers.
"""

from __future__ import annotations

import mmap
import os
import pickle
import signal
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Final

from afspm.basics import ConfigError
from afspm.driver import TCP, TRACE, ControllerLost
from afspm.plugins.gxsm import bridge_client, pickles
from afspm.plugins.gxsm.errors import BadReply, GxsmError
from afspm.plugins.gxsm.processes import GxsmProcess, NoProcess, find

_FOLDER: Final = Path("/dev/shm")
_BYTES: Final = 16_777_344
_NAME_BYTES: Final = 64
_STATUS, _LENGTH, _CONTENT = 100, 128, 136
_REQUEST: Final = 1
_FAILURES: Final = {
    -1: "GXSM can't pass on the result or error",
    -2: "GXSM has no Python",
    -3: "wrong flags",
    -4: "GXSM has no such function",
}
# in no folder of `tempfile`: a caller with another TMPDIR would hold another lock
_LOCK: Final = "/tmp/gxsm4_pyshm_transaction.lock"
_LOCK_SETTING: Final = "GXSM_PYSHM_LOCK_FILE"
_SOON_S, _LATER_S = 0.0001, 0.001
_LOOKS_SOON: Final = 20


class SharedMemoryLink:
    """A link through the block of a running Gxsm4. Not thread-safe.

    A request left in the block of an ended GXSM is withdrawn: the next instance would never answer the request.

    Args:
        block: name of the shared memory.
        process: name or number of GXSM's process.
        timeout_s: longest wait for an answer, real time.
        monotonic_s: returns real time.

    Raises:
        ControllerLost: there is no block, or not exactly one process that serves the block.
        ConfigError: the system is not Linux.
    """

    def __init__(self, block: str, process: str, timeout_s: float, monotonic_s: Callable[[], float]) -> None:
        if not sys.platform.startswith("linux"):
            hint = "run bridge.py in GXSM's console, and give its address"
            raise ConfigError("Gxsm4's shared memory is there on Linux alone", where="address", hint=hint)
        self._timeout_s = timeout_s
        self._monotonic_s = monotonic_s
        self._where = f"shm:{block}"
        # set by `close`, which so ends a wait between two polls of the memory
        self._closed = Event()
        path = _FOLDER / block
        try:
            self._process: GxsmProcess = find(process)
        except NoProcess:
            if path.exists():
                self._memory = self._mapped(path)
                with self._alone():
                    self._withdraw_request()
                self.close()
            raise
        self._memory = self._mapped(path)
        # traced in the form of the bridge's calls, so that a trace can be replayed on any system
        self._trace = TRACE.connection(TCP)

    def _mapped(self, path: Path) -> mmap.mmap:
        try:
            with path.open("r+b") as file:
                if os.fstat(file.fileno()).st_size < _BYTES:
                    raise ControllerLost(f"{path} is not Gxsm4's shared memory: it is too small")
                return mmap.mmap(file.fileno(), _BYTES)
        except OSError as error:
            hint = "is Gxsm4 running on this computer, by the same user, and without -s?"
            raise ControllerLost(f"no shared memory: {error}", where=self._where, hint=hint) from error

    def call(self, method: str, *arguments: str | int | float) -> object:
        if self._closed.is_set():
            raise ControllerLost("the link was closed", where=self._where)
        try:
            with self._alone(), self._trace.asking(method, bridge_client.message(method, *arguments)) as traced:
                found = self._transaction(method, arguments)
                traced.add(bridge_client.value_line(found))
                traced.is_whole = True
                return found
        except ControllerLost:
            self.close()
            raise

    def working_folder(self) -> Path | None:
        folder = self._process.working_folder()
        with self._trace.asking("getcwd", bridge_client.message("getcwd")) as traced:
            traced.add(bridge_client.value_line(str(folder)))
            traced.is_whole = True
        return folder

    def close(self) -> None:
        if not self._closed.is_set():
            self._closed.set()
            self._memory.close()

    def _transaction(self, method: str, arguments: tuple[str | int | float, ...]) -> object:
        until_s = self._monotonic_s() + self._timeout_s
        self._see_alive()
        # left by a caller that has stopped waiting: its answer would be taken for the answer to this call
        if self._status() == _REQUEST:
            before = self._memory[:_NAME_BYTES].split(b"\0", 1)[0].decode("latin-1")
            self._wait(until_s, f"GXSM is busy with an earlier call of {before!r} for more than {self._timeout_s:g} s")
        content = pickle.dumps(arguments, 4)
        name = method.encode()
        if len(name) >= _NAME_BYTES or len(content) > _BYTES - _CONTENT:
            raise GxsmError("the call is too long for GXSM's shared memory", where=method[:_NAME_BYTES])
        self._memory[:_NAME_BYTES] = name.ljust(_NAME_BYTES, b"\0")
        self._memory[_CONTENT : _CONTENT + len(content)] = content
        struct.pack_into("<Q", self._memory, _LENGTH, len(content))
        struct.pack_into("<q", self._memory, _STATUS, _REQUEST)
        try:
            self._process.signal(signal.SIGUSR1)
        except ControllerLost:
            self._withdraw_request()
            raise
        self._wait(until_s, f"no answer to {method} within {self._timeout_s:g} s")
        return self._answer(method)

    def _answer(self, method: str) -> object:
        status = self._status()
        if status in _FAILURES:
            raise GxsmError(_FAILURES[status], where=method)
        length = struct.unpack_from("<I", self._memory, _LENGTH)[0]  # a uint64, but GXSM itself reads 32 bits
        if status != 0 or length > _BYTES - _CONTENT:
            raise BadReply(f"GXSM replied {length} bytes, with the status {status}, to {method}", where=self._where)
        return pickles.loads(self._memory[_CONTENT : _CONTENT + length])

    def _status(self) -> int:
        return int(struct.unpack_from("<q", self._memory, _STATUS)[0])

    def _wait(self, until_s: float, complaint: str) -> None:
        looks = 0
        while self._status() == _REQUEST:
            looks += 1
            self._see_alive()
            if self._monotonic_s() >= until_s:
                hint = (
                    "after a call that blocks, GXSM answers only when it is restarted; started with -s it never answers"
                )
                raise ControllerLost(complaint, where=self._where, hint=hint)
            self._closed.wait(_SOON_S if looks < _LOOKS_SOON else _LATER_S)

    def _see_alive(self) -> None:
        # A request left in the block of an ended GXSM would stay there: the next instance never answers old requests.
        if not self._process.lives():
            self._withdraw_request()
            raise ControllerLost("Gxsm4 has ended", where=self._where)

    def _withdraw_request(self) -> None:
        # Call only under the lock.
        if self._status() == _REQUEST:
            struct.pack_into("<q", self._memory, _STATUS, 0)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        # The lock of GXSM's own tools: two callers at once receive each other's answers.
        import fcntl

        path = Path(os.environ.get(_LOCK_SETTING) or _LOCK)
        until_s = self._monotonic_s() + self._timeout_s
        try:
            file = path.open("a")
        except OSError as error:
            hint = (
                f"delete it, if no program uses it; or set {_LOCK_SETTING} to another file, for all of GXSM's callers"
            )
            raise ControllerLost(
                f"the lock file of GXSM's callers can't be opened: {error}", where=str(path), hint=hint
            ) from error
        with file:
            while True:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if self._monotonic_s() >= until_s:
                        raise ControllerLost(
                            "another program keeps GXSM's shared memory locked", where=str(path)
                        ) from None
                    self._closed.wait(_LATER_S)
            yield
