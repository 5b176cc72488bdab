"""Detection of a component's dependencies beyond its inputs, and a guard against side effects of a replay.

The guard uses Python's audit events, which precede the opening of a file or the start of a program. The watch uses
Python's profiler, which sees every call of a clock or of an unseeded random function of Python. The functions of numpy
are invisible to the profiler, so the state of numpy's global generator is compared before and after.
"""

from __future__ import annotations

import os
import random
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

_CLOCKS = {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "now", "utcnow", "today"}
_SILENT = ("logging", "tempfile", "threading", "importlib")
"""Modules of Python that read clocks, random bytes and files for purposes of their own."""
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_TRUNC
_PROGRAMS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.startfile"}
_NETWORK = {"socket.connect", "socket.bind", "socket.sendto", "socket.getaddrinfo"}
_CHANGES = {"os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.truncate", "os.link", "os.symlink", "shutil.move"}
_AFSPM = Path(__file__).resolve().parents[2]
_INFRASTRUCTURE = tuple(str(_AFSPM / room) for room in ("basics", "client", "storage", "transport", "wire", "model"))
_guards: dict[int, HazardGuard] = {}
_is_hooked = False


class ReplayForbids(PermissionError):
    """Error: a replayed component tries to change files, start a program or make a connection."""


class HazardGuard:
    """Guard that confines one replayed process to its folder; threads that the component starts are not guarded.

    Args:
        folder: folder of the replay, in which the component may do everything.
        known: folders of the record; other files of the user can be read, but count as a hazard.

    Attributes:
        seen: descriptions of the hazards, in order of occurrence.
        forbidden: description of the first action that was prevented; empty if there was none.
    """

    def __init__(self, folder: Path, known: tuple[Path, ...]) -> None:
        self._own = str(folder.resolve()) + os.sep
        paths = {*map(str, known), *sysconfig.get_paths().values(), sys.prefix, sys.base_prefix, str(_AFSPM)}
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
        sys.setprofile(self._profile)
        try:
            yield
        finally:
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
        elif event in _CHANGES:
            path = _path_of(args[0])
            if path is not None and not path.startswith((self._own, self._temporary)):
                self._forbid(f"changes a file outside its folder: {path}")

    def _on_open(self, path: object, mode: object, flags: object) -> None:
        found = _path_of(path)
        if found is None or found.startswith(self._own):
            return
        bits = flags if isinstance(flags, int) else 0
        if bits & _WRITING & ~os.O_CREAT or (isinstance(mode, str) and set(mode) & set("wax+")):
            is_new = bool(bits & (os.O_EXCL | getattr(os, "O_TMPFILE", 0)))
            if not (is_new and found.startswith(self._temporary)) and not found.startswith("/dev/"):
                self._forbid(f"writes a file outside its folder: {found}")
        elif not found.startswith(self._readable) and Path(found).is_file():
            self._note(f"reads a file that is not in the record: {found}")

    def _forbid(self, what: str) -> None:
        if self._note(what):
            self.forbidden = self.forbidden or what
            raise ReplayForbids(f"in a replay a component can't do this: it {what}")

    def _note(self, what: str) -> bool:
        place = _place(sys._getframe(1), through_afspm=True)
        if place is not None:
            self.seen.setdefault(f"{what} ({place})")
        return place is not None

    def _profile(self, frame: FrameType, event: str, called: Any) -> None:
        if event == "c_call" and (what := _hazard(called)) and (place := _place(frame)) is not None:
            self.seen.setdefault(f"{what} ({place})")


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
    # the nearest line outside of Python's library; None: afspm's own machinery, or the library for itself
    library = str(Path(sysconfig.get_paths()["stdlib"]).resolve()) + os.sep
    while frame is not None:
        file = frame.f_code.co_filename
        if frame.f_code.co_name == "<module>":
            return None  # a module that is imported: no decision of the component
        is_ours = file == __file__ or file.startswith(_INFRASTRUCTURE)
        in_library = file.startswith((library, "<frozen")) and "site-packages" not in file
        if is_ours and not through_afspm:
            return None
        if in_library and {Path(file).stem, Path(file).parent.name} & set(_SILENT):
            return None
        if not (in_library or is_ours):
            return f"{Path(file).name}:{frame.f_lineno} in {frame.f_code.co_name}"
        frame = frame.f_back
    return None


def _path_of(path: object) -> str | None:
    if isinstance(path, bytes):
        path = os.fsdecode(path)
    if not isinstance(path, str | os.PathLike):
        return None  # a descriptor that is open already
    return os.path.realpath(path)


def _hook() -> None:
    # an audit hook can't be removed, so all replays share one hook
    global _is_hooked
    if not _is_hooked:
        _is_hooked = True
        sys.addaudithook(_on_audit)


def _on_audit(event: str, args: tuple[Any, ...]) -> None:
    if _guards and (guard := _guards.get(threading.get_ident())) is not None:
        guard.on_event(event, args)
