"""Broken files: cut files are refused, and damage has no worse effect than a refusal."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.unit.storage import damage
from tests.unit.storage.corpus import reading, to_damage, whole
from tests.unit.storage.samples import WHOLE

from afspm.basics.errors import FileError
from afspm.model import Region, Scan
from afspm.record import nexus_writer
from afspm.storage.formats import hdf5_reading, read


# a Nanonis grid may end after any of its spectra: `test_nanonis_grids`
@pytest.mark.parametrize("name", [name for name in WHOLE if not name.endswith(".3ds")])
@settings(max_examples=20)
@given(data=st.data())
def test_a_file_that_was_cut_off_is_refused_or_holds_the_same(name: str, data: st.DataObject) -> None:
    damage.require_same_or_refusal_of_cut(name, data)


@pytest.mark.parametrize("name", [name for name in WHOLE if not name.endswith(".dat")])
def test_values_that_are_cut_off_are_refused(name: str) -> None:
    damage.require_refusal_without_values(name)


@pytest.mark.parametrize("name", to_damage(WHOLE))
@settings(max_examples=30)
@given(data=st.data())
def test_damaged_bytes_are_refused_or_read_and_nothing_else(name: str, data: st.DataObject) -> None:
    damage.require_values_or_refusal_of_damaged(name, data)


@pytest.mark.parametrize("size", [0, 2**63])
def test_string_heap_that_would_make_the_library_loop_is_refused(size: int) -> None:
    damaged = bytearray(whole("nsid.h5"))
    second = damaged.index(b"GCOL") + 16 + 16 + 8  # its first text is no longer than 8 bytes
    damaged[second + 8 : second + 16] = size.to_bytes(8, "little")
    with pytest.raises(FileError, match="do not add up"):
        reading(bytes(damaged), "nsid.h5")


# found by the nightly: the process that read it ended by SIGSEGV
def test_variable_length_of_an_unknown_kind_is_refused() -> None:
    damaged = bytearray(whole("image.nxs"))
    damaged[damaged.index(b"\x19\x01\x01\x00\x10\x00\x00\x00") + 1] = 0x0E
    with pytest.raises(FileError, match="has values of an unknown type"):
        reading(bytes(damaged), "image.nxs")


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


# faults 7
@pytest.mark.parametrize("number", [50, 51])
def test_file_of_too_many_groups_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(hdf5_reading, "_MOST_LINKS", 50)
    with h5py.File(tmp_path / "many.h5", "w") as file:
        for group in range(number):
            file.create_group(f"g{group}")
    with pytest.raises(FileError, match="more than 50 groups") if number > 50 else nullcontext():
        hdf5_reading.opened(tmp_path / "many.h5").close()


@pytest.mark.parametrize("depth", [90, 300])
def test_groups_nested_without_end_are_refused(tmp_path: Path, depth: int) -> None:
    file = tmp_path / "scan.h5"
    with h5py.File(file, "w") as deep:
        deep.create_group("/".join("g" * depth))
    with pytest.raises(FileError, match="nested") if depth > 100 else nullcontext():
        hdf5_reading.opened(file).close()
