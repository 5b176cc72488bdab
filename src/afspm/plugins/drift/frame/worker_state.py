"""State of the worker on disk: one .npz file of JSON and arrays, replaced as a whole, without code."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from afspm.basics import FileError, Plain
from afspm.components import write_atomic

_JSON = "json"
_ARRAY = "array"


class WorkerStateFile:
    """File for a state of numbers, texts, lists, dicts and numpy arrays.

    Args:
        path: the file; None: nothing is saved.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path

    def save(self, state: Plain) -> None:
        """Save a state atomically; a power cut leaves either the old or the new file.

        Raises:
            FileError: the file can't be written.
        """
        if self.path is None:
            return
        arrays: dict[str, np.ndarray] = {}
        text = json.dumps(_without_arrays(state, arrays))
        file = io.BytesIO()
        np.savez(file, **{_JSON: np.frombuffer(text.encode(), np.uint8)}, **arrays)  # type: ignore[arg-type]
        write_atomic(self.path, [file.getbuffer()], synced=True)

    def load(self) -> Plain | None:
        """Return the last saved state; None if there is none.

        Raises:
            FileError: the file can't be read.
        """
        if self.path is None or not self.path.exists():
            return None
        try:
            with self.path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                state = json.loads(arrays[_JSON].tobytes())
                found: Plain = _with_arrays(state, arrays)
        except Exception as error:  # numpy raises many kinds of exceptions for a damaged file
            raise FileError(
                f"can't be read: {error}", where=str(self.path), hint="remove it to start without it"
            ) from error
        return found


def _without_arrays(thing: object, arrays: dict[str, np.ndarray]) -> object:
    if isinstance(thing, np.ndarray):
        name = f"{_ARRAY}{len(arrays)}"
        arrays[name] = thing
        return {_ARRAY: name}
    if isinstance(thing, np.generic):
        return thing.item()
    if isinstance(thing, dict):
        return {str(key): _without_arrays(value, arrays) for key, value in thing.items()}
    if isinstance(thing, list | tuple):
        return [_without_arrays(value, arrays) for value in thing]
    return thing


def _with_arrays(thing: object, arrays: Mapping[str, np.ndarray]) -> Any:
    if isinstance(thing, dict):
        if thing.keys() == {_ARRAY}:
            return arrays[thing[_ARRAY]]
        return {key: _with_arrays(value, arrays) for key, value in thing.items()}
    if isinstance(thing, list):
        return [_with_arrays(value, arrays) for value in thing]
    return thing
