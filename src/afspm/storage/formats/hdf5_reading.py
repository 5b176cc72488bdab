"""Safe access to HDF5 files: damaged sizes and links to other files are refused."""

from __future__ import annotations

import struct
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from afspm.basics.errors import FileError
from afspm.storage.formats.content import text_of

if TYPE_CHECKING:
    import h5py

MAGIC = b"\x89HDF\r\n\x1a\n"
_HEAP = b"GCOL\x01\0\0\0"
_DEEPEST = 100  # a visit takes time with the square of the depth: 1,500 groups in each other take 11 s
_MOST_LINKS = 20_000  # to walk them takes 2 s, and 23 s with 60,000; a file of a scan has hundreds
_OBJECT = 16  # bytes of the header of an object
_OF_VLEN = 3  # byte of an encoded type with the kind of its variable length
_VALUES_PER_BYTE = 16  # well compressed data; a damaged header may announce any size


def is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def opened(path: Path) -> h5py.File:
    """Return the open file, which the caller closes.

    Raises:
        FileError: the file is not HDF5, has a damaged heap or type, or has a part in another file.
        OSError: the file can't be read, or is damaged otherwise.
    """
    import h5py

    if not is_hdf5(path):
        raise FileError("is not an HDF5 file", where=str(path))
    data = path.read_bytes()
    _check_heaps(data, path)
    try:
        # without a lock: files are written whole, and another program (or a file system without locks) may hold one
        file = h5py.File(path, "r", locking=False)
    except OSError:
        # if this process has the file open, as a notebook may, HDF5 opens it again with the same mode and lock alone
        file = h5py.File(h5py.h5f.open_file_image(data))
    try:
        _check_links(file, path)
        _check_types(file, path)
    except BaseException:  # after any error, Ctrl-C too, the caller has no file to close
        file.close()
        raise
    return file


def _check_links(file: h5py.File, path: Path) -> None:
    # security: through a link the library reads any file of this computer, and a picture or export of a stranger's
    # scan would show its content
    import h5py

    seen = count(1)

    def is_elsewhere(name: bytes, info: h5py.h5l.LinkInfo) -> bytes | int | None:
        # an error raised here would be lost in the library
        if (number := next(seen)) > _MOST_LINKS:
            return number
        return name if info.type == h5py.h5l.TYPE_EXTERNAL or name.count(b"/") > _DEEPEST else None

    def has_values_elsewhere(name: str, node: h5py.Dataset | h5py.Group) -> str | None:
        return name if isinstance(node, h5py.Dataset) and (node.external or node.is_virtual) else None

    root = file["/"].id
    found = root.links.visit(is_elsewhere, info=True) or file.visititems(has_values_elsewhere)
    if isinstance(found, int):
        raise FileError(f"is refused: it has more than {_MOST_LINKS:,} groups and datasets", where=str(path))
    if found is not None:
        name = found.decode("utf-8", "replace") if isinstance(found, bytes) else found
        if name.count("/") > _DEEPEST:
            raise FileError(f"is refused: its groups are nested more than {_DEEPEST} deep", where=str(path))
        raise FileError(f"is refused: /{name} is in another file", where=str(path))


def _check_types(file: h5py.File, path: Path) -> None:
    # a variable length is of a sequence (0) or a text (1, which has a class of its own); to read values of another one
    # ends the process with SIGSEGV (HDF5 2.0.0)
    from h5py import h5a, h5d, h5t

    nodes = [("", file["/"].id)]
    file.visititems(lambda name, node: nodes.append((name, node.id)))
    for name, node in nodes:
        kinds = [h5a.open(node, index=number).get_type() for number in range(h5a.get_num_attrs(node))]
        kinds += [node.get_type()] if isinstance(node, h5d.DatasetID) else []
        if any(kind.get_class() == h5t.VLEN and kind.encode()[_OF_VLEN] & 0xF for kind in kinds):
            raise FileError(f"is damaged: /{name} has values of an unknown type", where=str(path))


def _check_heaps(data: bytes, path: Path) -> None:
    # With wrong sizes in a heap of strings, the library loops for ever. A heap: "GCOL", the version (1), its size;
    # objects of number, reference count, size and data up to a multiple of 8; number 0 is the free rest, whose size
    # includes its header (HDF5 file format specification, III.E).
    at = data.find(_HEAP)
    while at >= 0:
        (size,) = struct.unpack_from("<Q", data.ljust(at + 16, b"\0"), at + 8)
        if at + size > len(data) or not _adds_up(data, at + 16, at + size):
            raise FileError("is damaged: the sizes in a heap of strings do not add up", where=str(path))
        at = data.find(_HEAP, at + 16)


def _adds_up(data: bytes, place: int, end: int) -> bool:
    while place + _OBJECT <= end:
        number, length = struct.unpack_from("<H6xQ", data, place)
        if number == 0:
            return bool(place + length == end)
        place += _OBJECT + (length + 7) // 8 * 8
    return place <= end


def array(dataset: h5py.Dataset) -> NDArray[np.float64]:
    """Return all values of a numeric dataset.

    Raises:
        FileError: the dataset announces more values than the file can hold.
    """
    most = _VALUES_PER_BYTE * dataset.file.id.get_filesize()
    if dataset.size is None or dataset.size > most:
        raise FileError(f"announces {dataset.size} values in {dataset.name} and holds fewer")
    return np.asarray(dataset[()], dtype=np.float64)


def texts(attributes: h5py.AttributeManager) -> dict[str, str]:
    """Return the attributes with text values."""
    return {key: text(value) for key, value in attributes.items() if isinstance(value, bytes | str)}


def text(value: object) -> str:
    """Return an attribute, or a dataset of characters, as text."""
    if isinstance(value, np.ndarray):
        value = value.tobytes()
    if isinstance(value, str):
        value = value.encode("utf-8", "surrogateescape")  # h5py keeps bytes that are not UTF-8 as surrogates
    if isinstance(value, bytes):
        return text_of(value.split(b"\0", 1)[0]).strip()
    return str(value).strip()
