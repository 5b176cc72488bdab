"""Atomic replacement of files: a reader finds the old content or the new."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from afspm.basics.errors import FileError
from afspm.model.events import NO_LONGER_TRUE
from afspm.storage.disk import SYNCER, DiskBacklogFull, DiskTask, DiskThread, DiskTimeout, sync_file, sync_folder

T = TypeVar("T")

PERIOD_S = 1.0
"""Real time between two synced copies of a generation."""
_DAMAGED = (ValueError, KeyError, TypeError)
LONGEST = 1 << 20
"""Size of a file of generations, in bytes, at which it is replaced."""
SLOW_S = 3.0
"""Real time that a disk may be busy before a warning."""
_TRIES, _AGAIN_S = 50, 0.01
_ANYONE = 0o666


def replace_file(
    path: Path,
    parts: Iterable[bytes | memoryview],
    *,
    synced: bool = True,
    soon: bool = False,
    aside: Path | None = None,
    mode: int = _ANYONE,
) -> None:
    """Replace a file completely or not at all, even if the process is killed.

    Args:
        synced: guarantee this over a power cut, too, and wait for the disk.
        soon: with `synced` False, sync the file a moment later. A power cut before that may leave a damaged file.
        aside: temporary path of the file; None: a hidden name of this process beside it.
        mode: mode of the file, before the umask; 0o600 for secrets, from its creation on.

    Raises:
        OSError: the file can't be written.
    """
    aside = aside or path.with_name(f".{path.name}.{os.getpid()}")
    try:
        is_new = _make_folder(path.parent)
        if mode != _ANYONE:
            aside.unlink(missing_ok=True)  # a file left by a killed process keeps its old mode
        with open(aside, "wb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.writelines(parts)
            file.flush()
            if synced:
                sync_file(file.fileno())
            elif soon:
                SYNCER.soon(file.fileno())
        _rename(aside, path)
        # without its own name a power cut takes a new folder with all that is synced in it
        for folder in (path.parent, path.parent.parent) if is_new else (path.parent,):
            if synced:
                sync_folder(folder)
            elif soon:
                SYNCER.folder_soon(folder)
    except OSError:
        with contextlib.suppress(OSError):
            aside.unlink()
        raise


def _make_folder(folder: Path) -> bool:
    # not its parents: where a drive is not mounted, they would be created on the system disk
    is_new = not folder.exists()
    folder.mkdir(exist_ok=True)
    return is_new


def _rename(aside: Path, path: Path) -> None:
    # Windows refuses to replace a file while another program, such as a virus scanner, reads it
    for left in reversed(range(_TRIES)):
        try:
            aside.replace(path)
            return
        except PermissionError:
            if sys.platform != "win32" or not left:
                raise
        threading.Event().wait(_AGAIN_S)  # Windows has no event for the close of another program's file


def write_atomic(path: Path, parts: Iterable[bytes | memoryview], *, synced: bool = True, soon: bool = False) -> None:
    """Replace a file, as `replace_file` does.

    Raises:
        FileError: the file can't be written.
    """
    try:
        replace_file(path, parts, synced=synced, soon=soon)
    except OSError as error:
        raise FileError(f"can't be written: {error}", where=str(path)) from error


class FileBatch:
    """New files that get their final names together; each is synced in a thread during the write of the next.

    Args:
        suffix: suffix of a file until it gets its name.
    """

    def __init__(self, suffix: str) -> None:
        self._suffix = suffix
        self._disk = DiskThread()
        self._files: list[tuple[DiskTask, Path, Path]] = []

    def write(self, path: Path, data: bytes) -> None:
        """Write a file under a temporary name.

        Raises:
            OSError: the file can't be written.
        """
        if _make_folder(path.parent):
            sync_folder(path.parent.parent)
        aside = path.with_name(path.name + self._suffix)
        try:
            with aside.open("wb") as file:
                file.write(data)
                descriptor = os.dup(file.fileno())
        except OSError:
            aside.unlink(missing_ok=True)  # a full disk: half a file would keep the rest of its room
            raise
        self._files.append((self._disk.submit(lambda: _sync_and_close(descriptor)), aside, path))

    def finish(self) -> None:
        """Rename all files once they are on the disk, then sync their folders.

        Raises:
            OSError: a file can't be synced or renamed.
        """
        for task, aside, path in self._files:
            task.wait()
            _rename(aside, path)
        for folder in {path.parent for _, _, path in self._files}:
            sync_folder(folder)
        self._files.clear()

    def discard(self) -> None:
        """Remove the files that still have a temporary name."""
        for task, aside, _ in self._files:
            with contextlib.suppress(OSError):
                task.wait()
            with contextlib.suppress(OSError):
                aside.unlink(missing_ok=True)
        self._files.clear()

    def close(self) -> None:
        """End the thread. Safe to repeat."""
        self._disk.close(0.0)


def _sync_and_close(descriptor: int) -> None:
    try:
        sync_file(descriptor)
    finally:
        os.close(descriptor)


class OutageLog:
    """A log of failed writes, one line for each outage; a full or missing disk must not end an experiment.

    A slow disk is logged as a warning after `SLOW_S`: a busy disk takes a moment now and then, and its writes are only
    late. A disk that refuses to write, or whose backlog is full so that data are lost, is CRITICAL at once, even after
    the warning.

    Args:
        loss: the consequence, for people.
        monotonic_s: clock of real time.
    """

    def __init__(self, loss: str, log: logging.Logger, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        self._loss = loss
        self._log = log
        self._monotonic_s = monotonic_s
        self._slow_since_s: float | None = None
        self._logged: int | None = None  # log level of the present outage

    @contextlib.contextmanager
    def trying(self) -> Iterator[None]:
        """Enclose a write: its FileError or OSError is logged and suppressed."""
        try:
            yield
        # a DiskBacklogFull is a DiskTimeout, so it comes first: its data are lost, not late
        except DiskBacklogFull as error:
            self._fails(error)
        except DiskTimeout:
            self._is_slow()
        except (FileError, OSError) as error:
            self._fails(error)
        else:
            self._works()

    def _fails(self, error: Exception) -> None:
        if self._logged != logging.CRITICAL:
            self._log.critical("%s: %s", self._loss, error)
        self._logged = logging.CRITICAL

    def _is_slow(self) -> None:
        now_s = self._monotonic_s()
        if self._slow_since_s is None:
            self._slow_since_s = now_s
        slow_s = now_s - self._slow_since_s
        if slow_s >= SLOW_S and self._logged is None:
            self._log.warning("%s: the disk has not answered for %.0f s", self._loss, slow_s)
            self._logged = logging.WARNING

    def _works(self) -> None:
        if self._logged is not None:
            lasted = ""
            if self._slow_since_s is not None:
                lasted = f"; the disk had not answered for {self._monotonic_s() - self._slow_since_s:.0f} s"
            self._log.info("writing works again%s; %s%s", lasted, NO_LONGER_TRUE, self._loss)
        self._slow_since_s = self._logged = None


def previous_generation(path: Path) -> Path:
    """Return the path of the previous generation of a file."""
    return path.with_name(f"{path.name}.old")


class CheckpointFile:
    """A file for a small state that is saved often, without waiting for the disk, and survives a power cut.

    Each generation is an appended line, which takes ten microseconds: a twentieth of a replacement of the file. The
    file is replaced only at `longest` bytes. The last line survives a kill of any process, and a moment later a power
    cut (see `disk`). A power cut during a replacement may leave the file empty. Then the previous generation is read; a
    thread syncs it, so it is at most about `period_s` older. An empty file without a previous generation is the first
    one, cut off in its first moment: it counts as no file.
    """

    def __init__(self, path: Path, period_s: float = PERIOD_S, longest: int = LONGEST) -> None:
        self.path = path
        self._period_s = period_s
        self._longest = longest
        self._file: io.FileIO | None = None
        self._size = 0
        self._newest: bytes | None = None
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def save(self, content: bytes) -> None:
        """Add a generation: a text without line breaks, whose beginning alone is never valid (a power cut may cut it).

        Raises:
            FileError: the text can't be written.
        """
        line = content + b"\n"
        try:
            self._append(line)
        except OSError as error:
            raise FileError(f"can't be written: {error}", where=str(self.path)) from error
        with self._changed:
            self._newest = line
            self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="generations", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Sync the last generation. Safe to repeat; a later `save` starts again."""
        self._closing.set()
        with self._changed:
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._closing.clear()
        self._let_go()

    def _append(self, line: bytes) -> None:
        if self._file is None or self._size + len(line) > self._longest or not _is_there(self._file):
            self._let_go()
            replace_file(self.path, [line], synced=False)
            self._file, self._size = io.FileIO(self.path, "ab"), len(line)
            SYNCER.soon(self._file.fileno())
            SYNCER.folder_soon(self.path.parent)
            return
        try:
            _append_whole(self._file, line, self._size)
        except OSError:
            self._let_go()  # after a drive returns, files that were open on it stay dead
            raise
        self._size += len(line)

    def _let_go(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._closing.is_set())
                newest, self._newest = self._newest, None
            if newest is None:
                return
            with contextlib.suppress(FileError):  # `save` reports a full disk
                write_atomic(previous_generation(self.path), [newest])
            self._closing.wait(self._period_s)


def append_generation(path: Path, line: bytes) -> None:
    """Add a generation to a file without waiting for the disk: a power cut may cut it off, and leaves those before.

    The file is replaced, and synced, if there is none, at `LONGEST` bytes, and behind a line that was cut off.

    Raises:
        FileError: the line can't be written.
    """
    try:
        with io.FileIO(path, "r+") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - 1))
            if file.read(1) == b"\n" and size + len(line) <= LONGEST:
                _append_whole(file, line, size)
                return
    except FileNotFoundError:
        pass
    except OSError as error:
        raise FileError(f"can't be written: {error}", where=str(path)) from error
    write_atomic(path, [line])


def _append_whole(file: io.FileIO, line: bytes, size: int) -> None:
    written = 0
    try:
        written = file.write(line)
        if written < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError:
        with contextlib.suppress(OSError):
            if written:
                file.truncate(size)  # remove the part: the generation before is the last again
        raise
    SYNCER.soon(file.fileno())


def _is_there(file: io.FileIO) -> bool:
    # an open file that was removed has no link left
    return os.fstat(file.fileno()).st_nlink > 0


def load_checkpoint(path: Path, read: Callable[[bytes], T]) -> tuple[T | None, str]:
    """Return the last readable generation in a file of `CheckpointFile`, and the damage of the last.

    Args:
        read: converts a generation; raises ValueError, KeyError or TypeError for a damaged generation.

    Returns:
        The converted generation, None if there is no file, or only the empty one of a first save that a power cut took
        back; and the damage of the last generation if an earlier generation was read, else "".

    Raises:
        FileError: no generation can be read, or neither the folder nor its parent exists.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError as error:
        if not any(folder.is_dir() for folder in (path.parent, path.parent.parent)):
            # the drive is not mounted: its file may exist, and must not be replaced by an empty one
            raise FileError(f"the folder of the run does not exist: {error}", where=str(path)) from error
        return None, ""
    except OSError as error:
        generations, damage = [], f"{error!r}"
    else:
        if not content and not previous_generation(path).exists():
            return None, ""
        generations = content.splitlines() or [b""]
        try:
            return read(generations.pop()), ""
        except _DAMAGED as error:
            damage = f"{error!r}"
    with contextlib.suppress(OSError):
        generations.insert(0, previous_generation(path).read_bytes())
    for before in reversed(generations):
        with contextlib.suppress(*_DAMAGED):
            return read(before), damage
    raise FileError(
        f"can't be read, and no earlier version of it exists: {damage}",
        where=str(path),
        hint="delete it to start with an empty one",
    )
