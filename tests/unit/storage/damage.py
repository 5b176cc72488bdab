"""Cut and damaged files, and pieces of files: refused with a name, or of sensible content."""

from __future__ import annotations

import contextlib
import math
import re
import struct
import tracemalloc
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st
from tests.unit.storage.corpus import reading, whole

from afspm.basics.errors import FileError
from afspm.storage.formats import FileContent

HEAD = 1 << 16
"""Of a real file, what is used of its beginning and of its end."""
LONGEST = 4000
MEMORY = 40
"""Bytes taken for each of a file, at most; text of numbers is the worst."""
ENOUGH = 1 << 22
TEXTS = [b"nan", b"-inf", b"1e999", b"-1", b"0", b"99999999999", b"1e-320", b"", b"x", b"\xb0", b"0x10", b"1,5", b"\0"]
NUMBERS = [0, 1, -1, 3, 2**15, 2**31 - 1, -(2**31), 2**30 + 1]
FIXED = (".ibw", ".nc", ".gwy", ".h5", ".nxs", ".nhf", ".tiff")
"""Suffixes of formats with fixed positions."""
ODD = st.one_of(
    st.binary(max_size=12),
    st.sampled_from(TEXTS),
    st.builds(lambda number, kind: struct.pack(kind, number), st.sampled_from(NUMBERS), st.sampled_from(["<q", ">q"])),
)


@cache
def ends(name: str) -> tuple[bytes, bytes]:
    return whole(name)[:HEAD], whole(name)[-HEAD:]


def require_sense(content: bytes, name: str) -> None:
    """Require sensible content of a file, or a refusal."""
    try:
        found = reading(content, name)
    except FileError as error:
        said = error
    else:
        makes_sense(found)
        return
    assert Path(name).name in said.where
    assert not re.search("MemoryError|RecursionError", str(said)), said


def makes_sense(found: FileContent) -> None:
    for scan in found.scans:
        assert scan.values.ndim == 2
        assert scan.values.dtype == np.float64
        assert min(scan.values.shape) > 1
        assert all(map(math.isfinite, (*scan.region.center_m, *scan.region.size_m, scan.region.angle_rad)))
        assert min(scan.region.size_m) > 0.0
    for curve in found.spectra:
        assert curve.values.shape[1] == len(curve.names) == len(curve.units)
        assert curve.position_m is None or all(map(math.isfinite, curve.position_m))


def pieces(names: Sequence[str]) -> st.SearchStrategy[list[bytes]]:
    """Return lists of pieces of these files, and of odd bytes."""
    piece = st.builds(
        lambda name, end, start, length: ends(name)[end][start : start + length],
        st.sampled_from(names),
        st.integers(0, 1),
        st.one_of(st.just(0), st.integers(0, HEAD)),
        st.integers(1, LONGEST),
    )
    return st.lists(st.one_of(piece, piece, ODD), max_size=6)


def require_sense_of_numbers(name: str, data: st.DataObject) -> None:
    """Put an odd text in the place of a number; of the same length in formats with fixed positions."""
    content = whole(name)
    numbers = list(re.finditer(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?", content[:HEAD]))
    found = data.draw(st.sampled_from(numbers))
    text = data.draw(st.sampled_from(TEXTS))
    if name.endswith(FIXED):
        text = text[: len(found[0])].ljust(len(found[0]))
    require_sense(content[: found.start()] + text + content[found.end() :], name)


def require_sense_of_sizes(name: str, data: st.DataObject) -> None:
    """Put impossible numbers into the header of a binary file."""
    content = bytearray(whole(name))
    most = min(len(content), 4096) - 8
    for _ in range(data.draw(st.integers(1, 2))):
        at = 2 * data.draw(st.integers(0, most // 2))
        kind = data.draw(st.sampled_from(["<h", "<i", ">i", "<q", ">q", "<d", ">d"]))
        number = data.draw(st.sampled_from(NUMBERS))
        value = data.draw(st.sampled_from([math.nan, math.inf, -1.0, 0.0])) if kind[1] == "d" else number
        if kind[1] == "h":
            value = max(-(2**15), min(number, 2**15 - 1))
        struct.pack_into(kind, content, at, value)
    damaged = mended(bytes(content), name)
    tracemalloc.start()
    try:
        require_sense(damaged, name)
        assert tracemalloc.get_traced_memory()[1] < MEMORY * len(damaged) + ENOUGH
    finally:
        tracemalloc.stop()


def mended(content: bytes, name: str) -> bytes:
    """Return the content with a correct checksum of Igor's header, without which nothing else would be read."""
    if not name.endswith(".ibw"):
        return content
    order = "<" if content[0] else ">"
    header = bytearray(content)
    struct.pack_into(f"{order}H", header, 2, 0)
    total = int(np.frombuffer(bytes(header[:384]), f"{order}i2").sum(dtype=np.int64))
    struct.pack_into(f"{order}H", header, 2, -total & 0xFFFF)
    return bytes(header)


def require_same_or_refusal_of_cut(name: str, data: st.DataObject) -> None:
    """Cut a file off: the same content if only unneeded bytes are missing; a table of text has fewer rows."""
    content = whole(name)
    length = data.draw(
        st.one_of(st.integers(0, len(content) - 1), st.integers(max(len(content) - 40, 0), len(content) - 1))
    )
    with contextlib.suppress(FileError):
        cut, full = reading(content[:length], name), reading(content, name)
        for part, complete in zip(cut, full, strict=True):
            rows = len(part.values) if name.endswith(".dat") else None
            np.testing.assert_array_equal(part.values, complete.values[:rows])


def require_refusal_without_values(name: str) -> None:
    content = whole(name)
    for length in (len(content) // 2, len(content) // 3):
        with pytest.raises(FileError):
            reading(content[:length], name)


def require_values_or_refusal_of_damaged(name: str, data: st.DataObject) -> None:
    """Damage up to eight bytes."""
    content = bytearray(whole(name))
    # headers are at the beginning, of some formats at the end
    places = st.one_of(
        st.integers(0, min(len(content), 3000) - 1),
        st.integers(max(len(content) - 1000, 0), len(content) - 1),
        st.integers(0, len(content) - 1),
    )
    for place in data.draw(st.lists(places, min_size=1, max_size=8)):
        content[place] = data.draw(st.integers(0, 255))
    with contextlib.suppress(FileError):
        for one in reading(bytes(content), name):
            assert one.values.ndim == 2
            assert one.values.dtype == np.float64
