"""The guaranteed state of a disk, in real processes: files as last synced, under the last synced names of a folder.

`restore` sets a folder to that state, as a power cut would. Python imports this module at its start if its folder is in
PYTHONPATH.

SQLite's own syncs are invisible here: its main file counts as synced when its write-ahead log is.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

FOLDER = os.environ.get("LOSSY_FOLDER", "")
WAL = "-wal"
_fsync, _unlink, _replace, _rename = os.fsync, os.unlink, os.replace, os.rename


class Shadow:
    """The synced state, kept beside the folder: contents by file, and names by folder.

    The time of a content is the start of its sync, in monotonic time.
    """

    def __init__(self, folder: str) -> None:
        self._folder = folder
        root = Path(f"{folder}.disk")
        self._files, self._contents, self._names = root / "files", root / "contents", root / "names"
        self._locks = root / "locks"
        for each in (self._files, self._contents, self._names, self._locks):
            each.mkdir(parents=True, exist_ok=True)

    def sync(self, descriptor: int, began_s: float) -> None:
        """Record the sync of a file or a folder."""
        path = str(Path(f"/proc/self/fd/{descriptor}").readlink())
        found = os.fstat(descriptor)
        if not self._watches(path) or not found.st_nlink:
            return
        if stat.S_ISDIR(found.st_mode):
            self._sync_names(path)
            return
        # by the descriptor: the file may get another name meanwhile
        files = {found.st_ino: f"/proc/self/fd/{descriptor}"}
        if path.endswith(WAL):
            main = path.removesuffix(WAL)
            files[os.stat(main).st_ino] = main  # noqa: PTH116
        self._sync_contents(files, began_s)

    def synced_s(self, suffix: str) -> float:
        """Return the start of the last sync of the files with a suffix: what was written before it is kept."""
        names = (pair for _, names in self._known() for pair in names.items())
        kept = (self._contents / content for name, content in names if name.endswith(suffix))
        return max((one.stat().st_mtime for one in kept if one.exists()), default=-math.inf)

    def _watches(self, path: Any) -> bool:
        return f"{path}/".startswith(f"{self._folder}/")

    @contextlib.contextmanager
    def _locked(self, name: str = "names") -> Iterator[None]:
        # between threads and processes: an older state recorded over a newer one would be a false loss
        with (self._locks / name).open("wb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _sync_contents(self, files: dict[int, str], began_s: float) -> None:
        with self._locked(f"content-{min(files)}"):
            copies = {}
            for number, path in files.items():
                copies[number] = self._contents / f".{uuid.uuid4()}"
                shutil.copyfile(path, copies[number])
                os.utime(copies[number], (began_s, began_s))
            # together: a kill between the copies would part SQLite's main file from its log
            for number, aside in copies.items():
                _replace(aside, self._contents / (self._content_of(number) or self._named(number)))

    def _content_of(self, number: int) -> str:
        with contextlib.suppress(FileNotFoundError):
            return (self._files / str(number)).read_text()
        return ""

    def _named(self, number: int) -> str:
        # another thread or process may be quicker: then its name counts
        name = str(uuid.uuid4())
        aside = self._files / f".{name}"
        aside.write_text(name)
        try:
            os.link(aside, self._files / str(number))
        except FileExistsError:
            return self._content_of(number) or self._named(number)
        finally:
            _unlink(aside)
        return name

    def _sync_names(self, path: str) -> None:
        with self._locked():
            entries = list(os.scandir(path))
            names = {
                entry.name: self._content_of(entry.inode()) or self._named(entry.inode())
                for entry in entries
                if entry.is_file(follow_symlinks=False)
            }
            folders = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
            aside = self._names / f".{uuid.uuid4()}"
            aside.write_text(json.dumps({"folder": path, "names": names, "folders": folders}))
            _replace(aside, self._names / path.replace("/", "%"))

    @contextlib.contextmanager
    def removing(self, path: Any) -> Iterator[None]:
        """Forget the file of this name once it is removed, unless it has another name: its number may be reused."""
        if not self._watches(path):
            yield
            return
        # no list of names is made meanwhile: it would give the file that is removed a new, empty content
        with self._locked():
            found = None
            with contextlib.suppress(OSError):
                found = os.lstat(path)
            yield
            if found is not None and stat.S_ISREG(found.st_mode) and found.st_nlink == 1:
                with contextlib.suppress(FileNotFoundError):
                    _unlink(self._files / str(found.st_ino))

    def _known(self) -> Iterator[tuple[str, dict[str, str]]]:
        # (folder, content by name) of each folder whose own name is synced, too
        lists = (json.loads(file.read_text()) for file in self._names.iterdir() if not file.name.startswith("."))
        known = {one["folder"]: one for one in lists}
        found = set[str]()
        for path in sorted(known):
            above, _, name = path.rpartition("/")
            if path == self._folder or (above in found and name in known[above]["folders"]):
                found.add(path)
                yield path, known[path]["names"]

    def restore(self) -> None:
        """Set the folder to its state after a power cut."""
        for path in [*Path(self._folder).rglob("*")]:
            if path.is_file() and not path.is_symlink():
                _unlink(path)
        for number in self._files.iterdir():
            _unlink(number)
        for path, content in self.copy(Path(self._folder)):
            (self._files / str(path.stat().st_ino)).write_text(content)

    def copy(self, into: Path) -> list[tuple[Path, str]]:
        """Write the state after a power cut to another folder; return each file with the name of its content."""
        copied = []
        for where, names in self._known():
            folder = into / Path(where).relative_to(self._folder)
            folder.mkdir(parents=True, exist_ok=True)
            for name, content in names.items():
                kept, path = self._contents / content, folder / name
                shutil.copyfile(kept, path) if kept.exists() else path.touch()
                copied.append((path, content))
        return copied


def watch(shadow: Shadow) -> None:
    """Record the syncs and removals of this process."""

    def syncing(call: Callable[[int], None]) -> Callable[..., None]:
        def called(descriptor: int) -> None:
            began_s = time.monotonic()
            call(descriptor)
            shadow.sync(descriptor, began_s)

        return called

    def removing(call: Callable[..., None], which: int) -> Callable[..., None]:
        def called(*arguments: Any, **options: Any) -> None:
            with shadow.removing(arguments[which]):
                call(*arguments, **options)

        return called

    os.fsync, os.fdatasync = syncing(os.fsync), syncing(os.fdatasync)
    os.unlink = os.remove = removing(os.unlink, 0)
    os.replace, os.rename = removing(_replace, 1), removing(_rename, 1)


if FOLDER and __name__ == "sitecustomize":
    watch(Shadow(FOLDER))
