"""What a component keeps on disk, so that it is there again after a crash or a kill."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Any

from afspm.errors import FileError, InvalidValue


class Memory(MutableMapping[str, Any]):
    """A dict of JSON values in a file. `save()` writes all of it, or nothing.

    Args:
        path: the file; None keeps nothing over a restart.
        synced: whether saving waits for the disk, which takes ten milliseconds and more, so that it outlives a power
            cut. A kill, of any process, it outlives in any case.

    Raises:
        FileError: the file can't be read, or holds something else.
    """

    def __init__(self, path: Path | None, *, synced: bool = True) -> None:
        self._path = path
        self._synced = synced
        self._values = _load(path) if path else {}

    def save(self) -> None:
        """Write everything to disk; when this returns it survives a kill, and, if synced, a power cut.

        Raises:
            InvalidValue: a value is not of JSON's types.
            FileError: the disk is full, the folder is gone …
        """
        try:
            text = json.dumps(self._values, ensure_ascii=False)
        except (TypeError, ValueError) as error:
            raise InvalidValue(
                f"a value can't be kept: {error}", where="memory", hint="keep numbers, texts, lists and dicts"
            ) from error
        if self._path is not None:
            write_whole(self._path, [text.encode()], synced=self._synced)

    def __getitem__(self, key: str) -> Any:
        return self._values[key]

    def __setitem__(self, key: str, value: Any) -> None:
        if not isinstance(key, str):  # JSON would turn it into a string, and it would not be found again
            raise InvalidValue(f"a key must be a text, not {key!r}", where="memory")
        self._values[key] = value

    def __delitem__(self, key: str) -> None:
        del self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"<Memory {self._values!r}>"


def write_whole(path: Path, parts: list[bytes], *, synced: bool = True) -> None:
    """Write a file so that it is there completely or as it was before, whenever the process is killed.

    Args:
        synced: the same of a power cut; that waits for the disk.

    Raises:
        FileError: it can't be written.
    """
    new = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with new.open("wb") as file:
            file.writelines(parts)
            if synced:
                file.flush()
                os.fsync(file.fileno())
        new.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            new.unlink()
        raise FileError(f"can't be written: {error}", where=str(path)) from error


def _load(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_bytes())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise FileError(f"can't be read: {error}", where=str(path), hint="remove it to start anew") from error
    if not isinstance(values, dict):
        raise FileError("is not what a component remembers", where=str(path), hint="remove it to start anew")
    return values
