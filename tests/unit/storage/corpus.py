"""Files to cut and damage: those of real microscopes, if present, and small ones in the controllers' formats."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from systems import not_on_wine
from tests.unit.storage.samples import DATA, WHOLE

import afspm
from afspm.storage.formats import FileContent, suffixes

_FILES = sorted(path.relative_to(DATA).as_posix() for path in DATA.rglob("*") if path.suffix in suffixes())
REAL = sorted({re.sub(r"\w+\.h5$|\d+", "", name): name for name in reversed(_FILES)}.values())
"""One of each series, and one .h5, all of which one program made: the others are built the same."""


@cache
def whole(name: str) -> bytes:
    """Return the bytes of a file in `WHOLE` or `REAL`."""
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
    return [pytest.param(name, marks=old) if name.endswith((".nc", ".h5", ".nhf")) else name for name in names]
