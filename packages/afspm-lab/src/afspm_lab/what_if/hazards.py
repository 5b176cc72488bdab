"""Detection of a component's dependencies beyond its inputs, and a guard against side effects of a replay.

The guard uses Python's audit events, which precede the opening of a file or the start of a program, in the component's
thread and in all threads that it starts. HDF5 and ZeroMQ raise no audit events, so `h5py.File` and `zmq.Socket` are
wrapped. Other libraries in C, such as a vendor's driver, are not guarded; a library loaded by ctypes is reported.

The watch uses Python's profiler, which sees every call of a clock or of an unseeded random function of Python. The
functions of numpy are invisible to the profiler, so the state of numpy's global generator is compared before and after.
"""

from __future__ import annotations

import os
import random
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import Any
from urllib.parse import unquote, urlsplit

import h5py
import zmq

import afspm

_CLOCKS = {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "now", "utcnow", "today"}
_SILENT = ("logging", "tempfile", "threading", "importlib", "traceback", "linecache")
"""Modules of Python that read clocks, random bytes and files for purposes of their own."""
_READS_ENVIRONMENT = type(os.environ).__getitem__.__code__
"""Code of the method through which `os.environ[…]`, its `get`, and the function getenv of `os` read."""
_IMPORT = "<frozen importlib"
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_TRUNC
_PROGRAMS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.startfile"}
_NETWORK = {"socket.connect", "socket.bind", "socket.sendto", "socket.getaddrinfo"}
_CHANGES = {  # the positions of the changed files, and of the descriptors of their folders
    "os.remove": ((0, 1),), "os.rmdir": ((0, 1),), "os.mkdir": ((0, 2),), "os.truncate": ((0, None),),
    "os.chmod": ((0, 2),), "os.chown": ((0, 3),), "os.utime": ((0, 3),), "os.rename": ((0, 2), (1, 3)),
    "shutil.rmtree": ((0, 1),), "os.link": ((1, 3),), "os.symlink": ((1, 2),), "shutil.move": ((0, None), (1, None)),
}  # fmt: skip
_AFSPM = Path(afspm.__file__).resolve().parent
_OWN = Path(__file__).resolve().parent
_ROOMS = ("basics", "client", "storage", "transport", "wire", "model")
_INFRASTRUCTURE = tuple(os.path.normcase(room) for room in (*(_AFSPM / room for room in _ROOMS), _OWN))
_guards: dict[int, HazardGuard] = {}
_threads: dict[threading.Thread, HazardGuard] = {}
"""Threads that a guarded thread has started; they stay guarded after the replay."""
_is_hooked = False


class ReplayForbids(PermissionError):
    """Error: a replayed component tries to change files, start a program or make a connection."""


class HazardGuard:
    """Guard that confines one replayed process, with all its threads, to its folder.

    Args:
        folder: folder of the replay, in which the component may do everything.
        known: folders of the record; other files of the user can be read, but count as a hazard.
        memory: file of the process's memory.
        on_saved: called with each new text of that file, just before it replaces the former text.

    Attributes:
        seen: descriptions of the hazards, in order of occurrence.
        forbidden: description of the first action that was prevented; empty if there was none.
    """

    def __init__(self, folder: Path, known: tuple[Path, ...], memory: Path, on_saved: Callable[[str], None]) -> None:
        self._own = str(folder.resolve()) + os.sep
        self._memory, self._on_saved = os.path.realpath(memory), on_saved
        paths = {*map(str, known), *sysconfig.get_paths().values(), sys.prefix, sys.base_prefix, str(_AFSPM), str(_OWN)}
        self._readable = (
            self._own,
            *(str(Path(path).resolve()) + os.sep for path in paths),
            "/proc/",
            "/dev/",
            "/sys/",
        )
        self._temporary = str(Path(tempfile.gettempdir()).resolve()) + os.sep
        self.seen: dict[str, None] = {}
        self.forbidden = ""
        self._made: set[str] = set()  # new files and folders in the folder of temporary files
        self._is_watching = False

    @contextmanager
    def active(self) -> Iterator[None]:
        """Guard the current thread within the block."""
        _hook()
        thread = threading.get_ident()
        _guards[thread] = self
        try:
            yield
        finally:
            del _guards[thread]

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Record uses of clocks and unseeded random functions within the block, at half the speed."""
        before = _numpy_state()
        self._is_watching = True
        sys.setprofile(self._profile)
        threading.setprofile(self._profile_thread)
        try:
            yield
        finally:
            self._is_watching = False
            threading.setprofile(None)
            sys.setprofile(None)
            if before is not None and _numpy_state() != before:  # its functions are invisible to the profiler
                self.seen.setdefault("draws random numbers of numpy without a seed of its own")

    def on_event(self, event: str, args: tuple[Any, ...]) -> None:
        """Process an audit event of the guarded thread. Raises ReplayForbids."""
        if event == "open":
            self._on_open(*args)
        elif event in _PROGRAMS:
            self._forbid(f"starts a program: {args[0]}")
        elif event in _NETWORK:
            self._forbid(f"uses the network: {args[-1] if event != 'socket.getaddrinfo' else args[0]}")
        elif event == "sqlite3.connect":
            self._on_database(args[0])
        elif event == "ctypes.dlopen":
            self._note(f"loads a library that a replay does not guard: {args[0]}")
        elif event in _CHANGES:
            if event == "os.rename" and _path_of(args[1]) == self._memory:
                self._on_saved(Path(args[0]).read_text(encoding="utf-8"))
            for at, folder_at in _CHANGES[event]:
                folder = args[folder_at] if folder_at is not None and folder_at < len(args) else None
                path = _path_of(args[at], folder)
                if path is not None and not self._may_write(path, is_new=event == "os.mkdir"):
                    self._forbid(f"changes a file outside its folder: {path}")

    def on_thread(self, thread: threading.Thread) -> None:
        """Guard a thread that the component is about to start."""
        for ended in [one for one in [*_threads] if one.ident is not None and not one.is_alive()]:
            _threads.pop(ended, None)
        _threads[thread] = self
        if self._is_watching:
            self._note("starts a thread, whose timing is not in the record", through_afspm=False)

    def _may_write(self, path: str, *, is_new: bool = False) -> bool:
        if path.startswith(self._own):
            return True
        if path == os.path.realpath(os.devnull):
            return True
        if not path.startswith(self._temporary):
            return False
        if is_new and not os.path.lexists(path):
            self._made.add(path)
        return any(path == made or path.startswith(made + os.sep) for made in self._made)

    def _on_database(self, database: object) -> None:
        if not isinstance(database, str | bytes | os.PathLike):
            return
        name = os.fsdecode(database)
        parts = urlsplit(name)
        if parts.scheme == "file":
            if {"mode=ro", "immutable=1", "mode=memory"} & {*parts.query.split("&")}:
                return
            name = unquote(parts.path)
        if name in ("", ":memory:"):
            return
        path = os.path.realpath(name)
        if not self._may_write(path, is_new=True):
            self._forbid(f"writes a file outside its folder: {path}")

    def _on_open(self, path: object, mode: object, flags: object) -> None:
        found = _path_of(path)
        if found is None or found.startswith(self._own):
            return
        bits = flags if isinstance(flags, int) else 0
        if bits & _WRITING & ~os.O_CREAT or (isinstance(mode, str) and set(mode) & set("wax+")):
            is_new = bool(bits & (os.O_EXCL | getattr(os, "O_TMPFILE", 0)))
            if not self._may_write(found, is_new=is_new):
                self._forbid(f"writes a file outside its folder: {found}")
        elif not found.startswith(self._readable) and Path(found).is_file():
            self._note(f"reads a file that is not in the record: {found}")

    def _forbid(self, what: str) -> None:
        place = _place(sys._getframe(1), through_afspm=True)
        if place == "":  # the library at work for the component
            is_own = threading.current_thread() in _threads
            place = f"in the thread {threading.current_thread().name}" if is_own else "through its settings"
        if place:
            self.seen.setdefault(f"{what} ({place})")
            self.forbidden = self.forbidden or what
            raise ReplayForbids(f"in a replay a component can't do this: it {what}")

    def _note(self, what: str, *, through_afspm: bool = True) -> None:
        if place := _place(sys._getframe(1), through_afspm=through_afspm):
            self.seen.setdefault(f"{what} ({place})")

    def _profile(self, frame: FrameType, event: str, called: object) -> None:
        if event == "c_call" and (what := _hazard(called)) and (place := _place(frame)):
            self.seen.setdefault(f"{what} ({place})")
        elif event == "call" and frame.f_code is _READS_ENVIRONMENT and (place := _place(frame)):
            self.seen.setdefault(f"reads the environment variable {frame.f_locals['key']} ({place})")

    def _profile_thread(self, frame: FrameType, event: str, called: object) -> None:
        sys.setprofile(self._profile if _guard_here() is self else None)


def _numpy_state() -> tuple[bytes, int] | None:
    numpy = sys.modules.get("numpy.random")
    if numpy is None:
        return None
    state = numpy.get_state(legacy=False)["state"]
    return state["key"].tobytes(), state["pos"]


def _hazard(called: Any) -> str:
    module, name, owner = getattr(called, "__module__", None), called.__name__, getattr(called, "__self__", None)
    if name in _CLOCKS and (module == "time" or "datetime" in str(owner)):
        return f"reads the wall clock by {name}(), instead of self.clock"
    if owner is random._inst:  # the generator behind the functions of `random`
        return "draws random numbers without a seed of its own"
    if name == "urandom" or type(owner) is random.SystemRandom:
        return "draws random bytes of the operating system"
    return ""


def _place(frame: FrameType | None, *, through_afspm: bool = False) -> str | None:
    # the nearest line outside of Python's library; "": none; None: afspm's own machinery, or the library for itself
    library = os.path.normcase(Path(sysconfig.get_paths()["stdlib"]).resolve()) + os.sep
    while frame is not None:
        file = os.path.normcase(frame.f_code.co_filename)
        if frame.f_code.co_name == "<module>" or file.startswith(_IMPORT):
            return None  # a module that is imported: no decision of the component
        is_ours = file.startswith(_INFRASTRUCTURE)
        in_library = file.startswith((library, "<frozen")) and "site-packages" not in file
        if is_ours and not through_afspm:
            return None
        names = {Path(file).stem, Path(file).parent.name}
        if in_library and names & {*_SILENT} and not (through_afspm and names & {"threading"}):
            return None
        if not (in_library or is_ours):
            return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno} in {frame.f_code.co_name}"
        frame = frame.f_back
    return ""


def _path_of(path: object, folder: object = None) -> str | None:
    if isinstance(path, bytes):
        path = os.fsdecode(path)
    if not isinstance(path, str | os.PathLike):
        return None  # a descriptor that is open already
    if isinstance(folder, int) and folder >= 0 and not Path(path).is_absolute():  # relative to an open folder
        opened = Path(f"/proc/self/fd/{folder}")
        return os.path.realpath(opened / path) if opened.exists() else None
    return os.path.realpath(path)


def _hook() -> None:
    # an audit hook can't be removed, so all replays share one hook, and one wrapper of each method
    global _is_hooked
    if _is_hooked:
        return
    _is_hooked = True
    sys.addaudithook(_on_audit)
    _before(threading.Thread, "start", HazardGuard.on_thread)
    _before(h5py.File, "__init__", _on_hdf5)
    for name in ("bind", "connect"):
        _before(zmq.Socket, name, _on_socket)


def _before(class_: type, name: str, check: Callable[..., None]) -> None:
    method = getattr(class_, name)

    @wraps(method)
    def checked(self: object, *given: object, **named: object) -> object:
        if (guard := _guard_here()) is not None:
            check(guard, self, *given, **named)
        return method(self, *given, **named)

    setattr(class_, name, checked)


def _on_hdf5(guard: HazardGuard, _: object, name: object, mode: str = "r", *__: object, **___: object) -> None:
    if mode != "r":
        guard.on_event("open", (name, "w", 0))


def _on_socket(guard: HazardGuard, _: object, addr: str, *__: object, **___: object) -> None:
    if not addr.startswith("inproc:"):
        guard.on_event("socket.connect", (None, addr))


def _on_audit(event: str, args: tuple[object, ...]) -> None:
    if (_guards or _threads) and (guard := _guard_here()) is not None:
        guard.on_event(event, args)


def _guard_here() -> HazardGuard | None:
    here = threading.get_ident()
    if (guard := _guards.get(here)) is not None:
        return guard
    return next((guard for thread, guard in [*_threads.items()] if thread.ident == here and thread.is_alive()), None)
