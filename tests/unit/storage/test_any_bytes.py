"""Any bytes under any suffix are refused with a name, or give sensible content.

They are pieces of files of real microscopes and of small ones in the controllers' formats, with numbers that no file
should have. No reader may take more memory or time than the file's size justifies.
"""

from __future__ import annotations

import math
import re
import struct
import tracemalloc
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.unit.storage.corpus import REAL, reading, to_damage, whole
from tests.unit.storage.samples import DATA, WHOLE

import afspm
from afspm.basics.errors import FileError
from afspm.storage.formats import FileContent, suffixes

pytest.importorskip("h5py")
pytest.importorskip("scipy")

HEAD = 1 << 16
"""Of a real file, what is used of its beginning and of its end."""
LONGEST = 4000
MEMORY = 40
"""Bytes taken for each of a file, at most; text of numbers is the worst."""
ENOUGH = 1 << 22
TEXTS = [b"nan", b"-inf", b"1e999", b"-1", b"0", b"99999999999", b"1e-320", b"", b"x", b"\xb0", b"0x10", b"1,5", b"\0"]
NUMBERS = [0, 1, -1, 3, 2**15, 2**31 - 1, -(2**31), 2**30 + 1]


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


PIECES = st.builds(
    lambda name, end, start, length: ends(name)[end][start : start + length],
    st.sampled_from([*WHOLE, *REAL]),
    st.integers(0, 1),
    st.one_of(st.just(0), st.integers(0, HEAD)),
    st.integers(1, LONGEST),
)
ODD = st.one_of(
    st.binary(max_size=12),
    st.sampled_from(TEXTS),
    st.builds(lambda number, kind: struct.pack(kind, number), st.sampled_from(NUMBERS), st.sampled_from(["<q", ">q"])),
)


@settings(max_examples=200, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.one_of(PIECES, PIECES, ODD), max_size=6), st.sampled_from(sorted(suffixes())))
def test_pieces_of_files_are_refused_or_make_sense(pieces: list[bytes], suffix: str) -> None:
    require_sense(b"".join(pieces), f"file{suffix}")


@pytest.mark.parametrize("name", to_damage([*WHOLE, *REAL]))
@settings(max_examples=10, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_impossible_number_is_refused_or_makes_sense(name: str, data: st.DataObject) -> None:
    """In a text, one of its numbers, of the same length in formats with fixed positions."""
    content = whole(name)
    numbers = list(re.finditer(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?", content[:HEAD]))
    found = data.draw(st.sampled_from(numbers))
    text = data.draw(st.sampled_from(TEXTS))
    if name.endswith((".ibw", ".nc", ".h5", ".nhf", ".tiff")):
        text = text[: len(found[0])].ljust(len(found[0]))
    require_sense(content[: found.start()] + text + content[found.end() :], name)


BINARY = [name for name in [*WHOLE, *REAL] if name.endswith((".ibw", ".nc", ".h5", ".nhf", ".tiff"))]


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


@pytest.mark.parametrize("name", BINARY)
@settings(max_examples=10, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_impossible_size_is_refused_or_makes_sense(name: str, data: st.DataObject) -> None:
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


def test_there_are_files_of_real_microscopes() -> None:
    if not REAL:
        pytest.skip(f"{DATA} is missing: only small files as the controllers write them were cut")
    assert {Path(name).suffix for name in REAL} == {".ibw", ".h5", ".sxm", ".dat", ".nc", ".vpdata"}


def test_a_spectrum_at_no_place_has_no_position(tmp_path: Path) -> None:
    for number, text in enumerate((b"NaN", b"Inf", b"1e999")):
        path = tmp_path / f"{number}.dat"
        path.write_bytes(whole("spectrum.dat").replace(b"300E-9", text))
        (curve,) = afspm.read(path).spectra
        assert curve.position_m is None
