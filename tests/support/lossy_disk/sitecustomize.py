"""The guaranteed state of a disk, in real processes: files as last synced, under the last synced names of a folder.

`restore` sets a folder to that state, as a power cut would. Python imports this module at its start if its folder is in
PYTHONPATH.

SQLite's own syncs are invisible here: its main file counts as synced when its write-ahead log is.
"""

from __future__ import annotations

import contextlib
import json
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
    """The synced state, kept beside the folder: contents by file, and names by folder."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        root = Path(f"{folder}.disk")
        self._files, self._contents, self._names = root / "files", root / "contents", root / "names"
        self._under_way = root / "under_way"
        for each in (self._files, self._contents, self._names, self._under_way):
            each.mkdir(parents=True, exist_ok=True)

    def sync(self, descriptor: int) -> None:
        """Record the sync of a file or a folder."""
        path = str(Path(f"/proc/self/fd/{descriptor}").readlink())
        if not f"{path}/".startswith(f"{self._folder}/"):
            return
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            self._sync_names(path)
            return
        self._sync_content(path, found.st_ino)
        if path.endswith(WAL):
            main = path.removesuffix(WAL)
            self._sync_content(main, os.stat(main).st_ino)  # noqa: PTH116

    @contextlib.contextmanager
    def syncing(self) -> Iterator[None]:
        """Record a running sync: a copy of the whole file here, which takes far longer than on a disk."""
        mark = self._under_way / str(uuid.uuid4())
        mark.write_text(str(time.monotonic()))
        try:
            yield
        finally:
            _unlink(mark)

    def longest_under_way_s(self) -> float:
        """Return the age of the oldest unfinished sync, and forget all."""
        now_s, longest_s = time.monotonic(), 0.0
        for mark in self._under_way.iterdir():
            began = mark.read_text()
            longest_s = max(longest_s, now_s - float(began) if began else 0.0)
            _unlink(mark)
        return longest_s

    def _sync_content(self, path: str, number: int) -> None:
        name = self._content_of(number) or self._named(number)
        aside = self._contents / f".{uuid.uuid4()}"
        shutil.copyfile(path, aside)
        _replace(aside, self._contents / name)

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
        names = {
            entry.name: self._content_of(entry.inode()) or self._named(entry.inode())
            for entry in os.scandir(path)
            if entry.is_file(follow_symlinks=False)
        }
        aside = self._names / f".{uuid.uuid4()}"
        aside.write_text(json.dumps({"folder": path, "names": names}))
        _replace(aside, self._names / path.replace("/", "%"))

    def forget(self, path: Any) -> None:
        """Forget the file of this name, unless it has another name: its inode number may be reused."""
        with contextlib.suppress(OSError):
            found = os.lstat(path)
            if str(path).startswith(self._folder) and stat.S_ISREG(found.st_mode) and found.st_nlink == 1:
                _unlink(self._files / str(found.st_ino))

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
        for known in [known for known in self._names.iterdir() if not known.name.startswith(".")]:
            told = json.loads(known.read_text())
            folder = into / Path(told["folder"]).relative_to(self._folder)
            folder.mkdir(parents=True, exist_ok=True)
            for name, content in told["names"].items():
                kept, path = self._contents / content, folder / name
                shutil.copyfile(kept, path) if kept.exists() else path.touch()
                copied.append((path, content))
        return copied


def watch(shadow: Shadow) -> None:
    """Record the syncs and removals of this process."""

    def syncing(call: Callable[[int], None]) -> Callable[..., None]:
        def called(descriptor: int) -> None:
            with shadow.syncing():
                call(descriptor)
                shadow.sync(descriptor)

        return called

    def removing(call: Callable[..., None], which: int) -> Callable[..., None]:
        def called(*arguments: Any, **options: Any) -> None:
            shadow.forget(arguments[which])
            call(*arguments, **options)

        return called

    os.fsync, os.fdatasync = syncing(os.fsync), syncing(os.fdatasync)
    os.unlink = os.remove = removing(os.unlink, 0)
    os.replace, os.rename = removing(_replace, 1), removing(_rename, 1)


if FOLDER and __name__ == "sitecustomize":
    watch(Shadow(FOLDER))
