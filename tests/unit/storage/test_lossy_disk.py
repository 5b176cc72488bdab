"""The guaranteed state of a disk, on which the tests of power cuts stand: nothing is lost that was synced."""

from __future__ import annotations

import os
import runpy
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="what a descriptor is open on is found in /proc")
LOSSY = Path(__file__).parents[2] / "support" / "lossy_disk" / "sitecustomize.py"


class Disk:
    """A folder on a lossy disk."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder = folder
        self.module = runpy.run_path(str(LOSSY))
        self.shadow = self.module["Shadow"](str(folder))

    def sync(self, path: Path) -> None:
        descriptor = os.open(path, os.O_RDONLY)
        self.shadow.sync(descriptor, 1.0)
        os.close(descriptor)

    def write(self, name: str, content: bytes) -> Path:
        path = self.folder / name
        path.write_bytes(content)
        self.sync(path)
        return path

    def after_a_cut(self, into: Path) -> dict[str, bytes]:
        into.mkdir()
        self.shadow.copy(into)
        return {path.name: path.read_bytes() for path in sorted(into.iterdir())}


@pytest.fixture
def disk(tmp_path: Path) -> Disk:
    return Disk(tmp_path / "run")


class Other:
    """Another process that syncs; `begin` returns once it is done, or waits for a lock."""

    def __init__(self, disk: Disk, monkeypatch: pytest.MonkeyPatch, do: Callable[[], None]) -> None:
        fcntl = disk.module["fcntl"]
        self._came, lock = threading.Event(), fcntl.flock
        self._thread = threading.Thread(target=self._run, args=(do,))

        def flock(*arguments: Any) -> None:
            if threading.current_thread() is self._thread:
                self._came.set()
            lock(*arguments)

        monkeypatch.setattr(fcntl, "flock", flock)

    def _run(self, do: Callable[[], None]) -> None:
        do()
        self._came.set()

    def begin(self) -> None:
        self._thread.start()
        assert self._came.wait(60.0)

    def end(self) -> None:
        self._thread.join()


def test_older_list_of_names_is_not_recorded_over_a_newer_one(
    disk: Disk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """faults 17: recorder and microscope both sync the folder `scans`."""
    disk.write("scan-1.nc", b"1")

    other, real = Other(disk, monkeypatch, lambda: disk.sync(disk.folder)), os.scandir

    def scandir(path: Any) -> Iterator[os.DirEntry[str]]:
        entries = list(real(path))
        if threading.current_thread() is threading.main_thread():
            disk.write("scan-1.h5", b"2")
            other.begin()  # has synced a newer list, unless it has to wait
        return iter(entries)

    monkeypatch.setattr(os, "scandir", scandir)
    disk.sync(disk.folder)
    other.end()
    assert disk.after_a_cut(tmp_path / "after") == {"scan-1.h5": b"2", "scan-1.nc": b"1"}


def test_list_of_names_is_made_before_or_after_a_replacement(
    disk: Disk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = disk.write("run.json", b"old")
    disk.sync(disk.folder)
    aside = disk.write("aside", b"new")
    other = Other(disk, monkeypatch, lambda: disk.sync(disk.folder))
    with disk.shadow.removing(path):
        other.begin()
        aside.replace(path)
    other.end()
    assert disk.after_a_cut(tmp_path / "after") == {"run.json": b"new"}


def test_folder_is_lost_with_all_in_it_until_its_name_is_synced(disk: Disk, tmp_path: Path) -> None:
    (disk.folder / "scans").mkdir()
    disk.write("scans/scan-1.h5", b"1")
    disk.sync(disk.folder / "scans")
    assert disk.after_a_cut(tmp_path / "before") == {}
    disk.sync(disk.folder)
    disk.shadow.copy(tmp_path / "after")
    assert (tmp_path / "after" / "scans" / "scan-1.h5").read_bytes() == b"1"


def test_last_sync_of_the_log_is_known(disk: Disk) -> None:
    assert disk.shadow.synced_s(".packets") < 0.0
    disk.write("1.packets", b"")
    assert disk.shadow.synced_s(".packets") < 0.0, "its name is not on the disk yet"
    disk.sync(disk.folder)
    assert disk.shadow.synced_s(".packets") == 1.0
