"""A component's memory: a dict on disk that is there again after a crash or a kill."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Any

from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain
from afspm.storage.atomic import CheckpointFile, OutageLog, load_checkpoint, previous_generation, write_atomic
from afspm.storage.disk import DEADLINE_S, DiskThread

SYNCED_WITHIN_S = 5.0  # longest wait for the disk; one that hangs counts as full
_log = logging.getLogger("afspm.memory")


class Memory(MutableMapping[str, Any]):
    """A dict of JSON values in a file. `save()` writes all of it, or nothing.

    Args:
        path: the file; None keeps nothing over a restart.
        synced: whether saving waits for the disk, ten milliseconds and more, so that all of it outlives a power cut. If
            not, what was saved a moment before a power cut outlives that. A kill, of any process, it outlives anyway.

    Attributes:
        damage: what was wrong with the file, where the generation before was taken up in its place; "" else.

    Raises:
        FileError: the file can't be read, or holds something else.
    """

    def __init__(self, path: Path | None, *, synced: bool = True) -> None:
        self._path = path
        self._generations = CheckpointFile(path) if path and not synced else None
        self._disk = DiskThread(SYNCED_WITHIN_S if synced else DEADLINE_S)
        self._told = OutageLog("a restart would not know what was done until now", _log)
        self.damage = ""
        self._values: Plain = {}
        if path is not None:
            values, self.damage = load_checkpoint(path, _read)
            self._values = values or {}
        self._saved = json.dumps(self._values, ensure_ascii=False)

    def save(self, *, synced: bool = True) -> bool:
        """Write everything to disk; when this returns it survives a kill, and, if synced, a power cut.

        In a loop that the disk must not slow down, `save(synced=False)` is enough for what may be repeated after a
        power cut: what was saved a moment before one outlives it.

        A disk that is full, away or hangs must not end the experiment: it is logged. A caller that does something that
        must not happen twice looks at what is returned, and doesn't do it.

        Returns:
            True if it was written.

        Raises:
            InvalidValue: a value is not of JSON's types.
        """
        return self._write(self._text(), synced=synced)

    def save_changes(self) -> None:
        """`save`, if anything is other than it was saved last, however deep within."""
        if (text := self._text()) != self._saved:
            self._write(text, synced=True)

    @property
    def saved_text(self) -> str:
        """Everything that survives a restart, as JSON."""
        return self._saved

    def _write(self, text: str, *, synced: bool) -> bool:
        with self._told.trying():
            if (generations := self._generations) is not None:
                self._disk.run(lambda: generations.save(text.encode()))
            elif (path := self._path) is not None:
                self._disk.run(lambda: _replace(path, text, synced=synced))
            self._saved = text
            return True
        return False

    def _text(self) -> str:
        try:
            return json.dumps(self._values, ensure_ascii=False, default=_number)
        except (TypeError, ValueError) as error:
            raise InvalidValue(
                f"a value can't be kept: {error}", where="memory", hint="keep numbers, texts, lists and dicts"
            ) from error

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


def _replace(path: Path, text: str, *, synced: bool) -> None:
    if not synced:  # a power cut may damage the new file; the one before is on the disk by now
        aside = path.with_name(f".{path.name}.before")
        with contextlib.suppress(OSError):  # the first one, or a file system without links
            aside.unlink(missing_ok=True)
            os.link(path, aside)
            aside.replace(previous_generation(path))
    write_atomic(path, [text.encode(), b"\n"], synced=synced, soon=not synced)


def _number(value: Any) -> Any:
    """Return a number of numpy as one of Python's."""
    if getattr(value, "shape", None) == ():
        return value.item()
    raise TypeError(f"it is of the type {type(value).__name__}")


def _read(content: bytes) -> Plain:
    values = json.loads(content)
    if not isinstance(values, dict):
        raise ValueError("it is not what a component remembers")
    return values
