"""Broken files: cut files are refused, and damage has no worse effect than a refusal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.unit.storage.corpus import reading, to_damage, whole
from tests.unit.storage.samples import DATA, WHOLE

from afspm.basics.errors import FileError
from afspm.model import Region, Scan
from afspm.record import nexus_writer
from afspm.storage.formats import read

h5py = pytest.importorskip("h5py")
pytest.importorskip("scipy")

SOME = [
    "asylum/DTMicroscope_scan_0001.ibw",
    "asylum/fmt-igor-fd_SiN_FD_plot.ibw",
    "nanonis/ProbeFlow_nanonis.sxm",
    "nanonis/Bias-Spectroscopy002.dat",
    "gxsm/gxsm3/scan002-M-Xp-Topo.nc",
    "gxsm/gxsm4/scan002-M-Xp-ZSmTopo.nc",
    "gxsm/gxsm4/scan006-VP001-VP.vpdata",
]


def need(name: str) -> None:
    if name not in WHOLE and not (DATA / name).is_file():
        pytest.skip(f"{DATA / name} is missing")


@pytest.mark.parametrize("name", [*WHOLE, *SOME])
@settings(max_examples=20)
@given(data=st.data())
def test_a_file_that_was_cut_off_is_refused_or_holds_the_same(name: str, data: st.DataObject) -> None:
    """The same content if only unneeded bytes are cut off; a table of text cut at a line is a shorter table."""
    need(name)
    content = whole(name)
    length = data.draw(
        st.one_of(st.integers(0, len(content) - 1), st.integers(max(len(content) - 40, 0), len(content) - 1))
    )
    with contextlib.suppress(FileError):
        cut, full = reading(content[:length], name), reading(content, name)
        for part, complete in zip(cut, full, strict=True):
            rows = len(part.values) if name.endswith(".dat") else None
            np.testing.assert_array_equal(part.values, complete.values[:rows])


@pytest.mark.parametrize("name", [n for n in [*WHOLE, *SOME] if not n.endswith(".dat")])
def test_values_that_are_cut_off_are_refused(name: str) -> None:
    need(name)
    content = whole(name)
    for length in (len(content) // 2, len(content) // 3):
        with pytest.raises(FileError):
            reading(content[:length], name)


@pytest.mark.parametrize("name", to_damage([*WHOLE, *SOME]))
@settings(max_examples=30)
@given(data=st.data())
def test_damaged_bytes_are_refused_or_read_and_nothing_else(name: str, data: st.DataObject) -> None:
    need(name)
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


@pytest.mark.parametrize("size", [0, 2**63])
def test_string_heap_that_would_make_the_library_loop_is_refused(size: int) -> None:
    damaged = bytearray(whole("nsid.h5"))
    second = damaged.index(b"GCOL") + 16 + 16 + 8  # its first text is no longer than 8 bytes
    damaged[second + 8 : second + 16] = size.to_bytes(8, "little")
    with pytest.raises(FileError, match="do not add up"):
        reading(bytes(damaged), "nsid.h5")


def _by_link(file: Any, name: str, secret: Path) -> None:
    file[name] = h5py.ExternalLink(secret.name, "/values")


def _by_external_storage(file: Any, name: str, secret: Path) -> None:
    file.create_dataset(name, (2, 4), "f8", external=[(secret.name, 0, 64)])


def _by_virtual_dataset(file: Any, name: str, secret: Path) -> None:
    layout = h5py.VirtualLayout((2, 4), "f8")
    layout[:] = h5py.VirtualSource(secret.name, "values", (2, 4))
    file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize("elsewhere", [_by_link, _by_external_storage, _by_virtual_dataset])
def test_values_that_are_in_another_file_are_refused(
    elsewhere: Callable[[Any, str, Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a picture or export of a stranger's scan would show the content of a file of this computer."""
    monkeypatch.chdir(tmp_path)  # where external storage is looked for
    with h5py.File(tmp_path / "secret.h5", "w") as secret:
        secret["values"] = np.full((2, 4), 42.0)
    scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.zeros((2, 4)), 5, "one.dat")
    file = tmp_path / "scan.h5"
    file.write_bytes(nexus_writer.encode_scan([scan], nexus_writer.FileProvenance(5, None, {}, {})))
    assert read(file).scans[0].values.shape == (2, 4)
    with h5py.File(file, "r+") as changed:
        (name,) = (key for key, node in changed["entry/data"].items() if getattr(node, "ndim", 0) == 2)
        del changed["entry/data"][name]
        elsewhere(changed, f"entry/data/{name}", tmp_path / "secret.h5")
    with pytest.raises(FileError, match="in another file"):
        read(file)
