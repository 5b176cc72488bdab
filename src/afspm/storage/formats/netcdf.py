"""NetCDF, classic format: arrays with named dimensions, units and attributes in one file, through scipy.

xarray, MATLAB, `ncdump` and many scripts read it. Written values are float64.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from afspm.basics.errors import FileError
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.storage.formats.content import text_of

Attributes = Mapping[str, str | float]


@dataclass(frozen=True)
class Variable:
    """One array: the names of its dimensions, float64 values, attributes such as units."""

    dimensions: tuple[str, ...]
    values: NDArray[np.float64]
    attributes: Attributes = field(default_factory=dict)


@dataclass(frozen=True)
class File:
    """The numeric arrays of a file, its character arrays as texts, and the global attributes."""

    variables: Mapping[str, Variable]
    texts: Mapping[str, str]
    attributes: Attributes


def encoded(variables: Mapping[str, Variable], attributes: Attributes) -> bytes:
    """Return the bytes of a file."""
    made = io.BytesIO()
    file = _netcdf_file(made, "w")
    file._attributes.update(_as_bytes(attributes))  # not by setattr: some names are attributes of the scipy object
    for name, variable in variables.items():
        for axis, size in zip(variable.dimensions, variable.values.shape, strict=True):
            if axis not in file.dimensions:
                file.createDimension(axis, size)
        written = file.createVariable(name, ">f8", variable.dimensions)
        written[:] = variable.values
        written._attributes.update(_as_bytes(variable.attributes))
    file.flush()
    return made.getvalue()


def read(path: Path) -> File:
    """Return the variables and global attributes of a file.

    Raises:
        FileError: the file is missing, incomplete or of another format.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileError(f"can't be read: {error}", where=str(path)) from error
    if content[:4] not in (b"CDF\x01", b"CDF\x02"):
        raise FileError("is not a NetCDF file of the classic format", where=str(path))
    try:
        # not the file on disk: for that scipy allocates any size that a damaged header announces
        file = _netcdf_file(io.BytesIO(content), "r")
        return _file(file)
    except FileError:
        raise
    except Exception as error:  # on a damaged file scipy raises errors of many types
        raise FileError(f"is incomplete: {type(error).__name__}: {error}", where=str(path)) from error


def _file(file: Any) -> File:
    variables: dict[str, Variable] = {}
    texts: dict[str, str] = {}
    for name, found in file.variables.items():
        if found.data.dtype.kind == "S":
            texts[name] = _text(found.data.tobytes())
        else:
            variables[name] = Variable(found.dimensions, found.data.astype(np.float64), _plain(found._attributes))
    return File(variables, texts, _plain(file._attributes))


def _netcdf_file(content: io.BytesIO, mode: Literal["r", "w"]) -> Any:
    from scipy.io import netcdf_file

    # version 2 has 64-bit offsets: files of the first version end at 2 GB
    return netcdf_file(content, mode, mmap=False, version=2)


def _as_bytes(attributes: Attributes) -> Plain:
    return {name: value.encode() if isinstance(value, str) else np.float64(value) for name, value in attributes.items()}


def _plain(attributes: PlainMapping) -> dict[str, str | float]:
    # text as text; of an array of numbers only the first
    return {
        name: _text(value) if isinstance(value, bytes) else float(np.ravel(value)[0])
        for name, value in attributes.items()
    }


def _text(raw: bytes) -> str:
    return text_of(raw.split(b"\0", 1)[0])
