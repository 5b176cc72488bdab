"""Opens HDF5 files, and reads arrays of them without trusting their sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from afspm.errors import FileError

MAGIC = b"\x89HDF\r\n\x1a\n"
_VALUES_MAX = 1 << 28  # a broken header may promise any size


def is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def opened(path: Path) -> Any:
    """The file; to be closed. Raises FileError: h5py is missing, or it is none."""
    try:
        import h5py
    except ImportError:
        raise FileError("reading HDF5 needs h5py", where=str(path), hint='pip install "afspm[files]"') from None
    if not is_hdf5(path):
        raise FileError("is no HDF5 file", where=str(path))
    return h5py.File(path, "r")


def array(dataset: Any) -> NDArray[np.float64]:
    """All values of a dataset of numbers. Raises FileError: it promises more than any scan has."""
    if dataset.size is None or dataset.size > _VALUES_MAX:
        raise FileError(f"promises {dataset.size} values in {dataset.name}")
    return np.asarray(dataset[()], dtype=np.float64)


def text(value: Any) -> str:
    """An attribute, or a dataset of characters, as text."""
    if isinstance(value, np.ndarray):
        value = value.tobytes()
    if isinstance(value, bytes):
        return value.split(b"\0", 1)[0].decode("utf-8", "replace").strip()
    return str(value).strip()
