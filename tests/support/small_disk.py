"""A small file system and how to fill it, and a small limit for the size of files."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """Mount a file system of 64 MB at a new folder."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        pytest.skip("only root may mount a file system")
    folder.mkdir()
    mounted = subprocess.run(("mount", "-t", "tmpfs", "-o", "size=64m", "none", str(folder)), check=False)
    if mounted.returncode:
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(("umount", "-l", str(folder)), check=True)


def fill(file: Path) -> None:
    """Write a file that takes up the whole disk."""
    with file.open("wb", buffering=0) as stream:
        for size in (1 << 16, 1 << 12):  # the last page, too: a small record would still find room in it
            with suppress(OSError):
                while stream.write(bytes(size)):
                    pass


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    """Let the system refuse bytes of files beyond a size, as a full disk does, which only root can make."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
