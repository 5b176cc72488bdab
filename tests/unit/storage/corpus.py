"""Files to cut and damage: small ones in the controllers' formats, and for `make real-data` real ones."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from benchmarks.data_folder import DATA
from systems import not_on_wine
from tests.unit.storage.samples import WHOLE

import afspm
from afspm.storage.formats import FileContent


@cache
def whole(name: str) -> bytes:
    """Return the bytes of a file in `WHOLE`, or of one in the folder of real files."""
    if name not in WHOLE:
        return (DATA / name).read_bytes()
    with TemporaryDirectory() as folder:
        WHOLE[name](Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def reading(content: bytes, name: str) -> FileContent:
    """Return the content of a file with that name. Raises FileError, as `afspm.read`."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / Path(name).name
        path.write_bytes(content)
        return afspm.read(path)


def to_damage(names: Iterable[str]) -> list[Any]:
    """Return the parameters of a test that reads damaged files."""
    old = not_on_wine("the older HDF5 that runs there ends the process on some damaged files")
    return [pytest.param(name, marks=old) if name.endswith((".nc", ".h5", ".nxs", ".nhf")) else name for name in names]
