"""A component's memory: a dict on disk that survives a crash or kill."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Any

from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain, from_json
from afspm.storage.atomic import CheckpointFile, OutageLog, append_generation, load_checkpoint, write_atomic
from afspm.storage.disk import DEADLINE_S, DiskThread

SYNCED_WITHIN_S = 5.0  # longest wait; a disk that hangs counts as full
_log = logging.getLogger("afspm.memory")


class Memory(MutableMapping[str, Any]):
    """A dict of JSON values in a file. `save()` writes all of it, or nothing.

    Args:
        path: the file; None: nothing is kept over a restart.
        synced: whether saving waits for the disk, ten milliseconds and more, so that it survives a power cut. Otherwise
            a power cut may undo the last save. A kill of any process undoes nothing in either case.

    Attributes:
        damage: the damage of the file, if an earlier generation was read instead; "" else.

    Raises:
        FileError: no generation of the file can be read as a JSON object.
    """

    def __init__(self, path: Path | None, *, synced: bool = True) -> None:
        self._path = path
        self._generations = CheckpointFile(path) if path and not synced else None
        self._disk = DiskThread(SYNCED_WITHIN_S if synced else DEADLINE_S)
        self._outage = OutageLog("a restart would not know what was done until now", _log)
        self.damage = ""
        self._values: Plain = {}
        if path is not None:
            values, self.damage = load_checkpoint(path, _read)
            self._values = values or {}
        self._saved = json.dumps(self._values, ensure_ascii=False)

    def save(self, *, synced: bool = True) -> bool:
        """Write all values to disk, so that they survive a kill and, if synced, a power cut.

        In a loop that the disk must not slow down, `save(synced=False)` is enough for values whose loss only repeats
        work: after a power cut the values of the previous save remain.

        A full, missing or hanging disk must not end the experiment, so it is only logged. Check the result before an
        action that must not happen twice.

        Returns:
            True if the values were written, or there is no file; False if writing failed, or is late.

        Raises:
            InvalidValue: a value is not of JSON's types.
        """
        return self._write(self._text(), synced=synced)

    def save_changes(self) -> None:
        """Save if any value differs from the last save, at any depth."""
        if (text := self._text()) != self._saved:
            self._write(text, synced=True)

    def close(self) -> None:
        """End the threads that write; a later save starts others."""
        if (generations := self._generations) is not None:
            with self._outage.trying():
                self._disk.run(generations.close)
        self._disk.close(DEADLINE_S)

    @property
    def saved_text(self) -> str:
        """All values as JSON, as of the last successful save."""
        return self._saved

    def _write(self, text: str, *, synced: bool) -> bool:
        # after a failure `_saved` keeps the old text, so the next `save_changes` writes again
        with self._outage.trying():
            if (generations := self._generations) is not None:
                self._disk.run(lambda: generations.save(text.encode()))
            elif (path := self._path) is not None:
                line = text.encode() + b"\n"
                self._disk.run(lambda: write_atomic(path, [line]) if synced else append_generation(path, line))
            self._saved = text
            return True
        return False

    def _text(self) -> str:
        try:
            _check_keys(self._values)
            return json.dumps(self._values, ensure_ascii=False, default=_number)
        except (TypeError, ValueError) as error:
            raise InvalidValue(
                f"a value can't be kept: {error}", where="memory", hint="keep numbers, texts, lists and dicts"
            ) from error

    def __getitem__(self, key: str) -> Any:
        return self._values[key]

    def __setitem__(self, key: str, value: object) -> None:
        if not isinstance(key, str):  # as `_check_keys`, but at once
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


def _check_keys(value: object) -> None:
    # JSON turns keys into strings: after a restart the key would be another, and what was done would be done again
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"a key must be a text, not {key!r}")
        value = value.values()
    elif not isinstance(value, list | tuple):
        return
    for one in value:
        if isinstance(one, dict | list | tuple):
            _check_keys(one)


def _number(value: Any) -> object:
    # numpy's scalars become Python's numbers
    if getattr(value, "shape", None) == ():
        return value.item()
    raise TypeError(f"it is of the type {type(value).__name__}")


def _read(content: bytes) -> Plain:
    values = from_json(content)
    if not isinstance(values, dict):
        raise ValueError("the file is not the memory of a component")
    return values
