"""The page shows a full disk until there is room again, and the report afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.ui.ui_lab import Night, Opened

from afspm.record.report import REPORT_FILE


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Path]:
    """A small file system of its own for the run folders."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        pytest.skip("only root may mount a file system")
    runs = tmp_path / "runs"
    runs.mkdir()
    mounted = subprocess.run(("mount", "-t", "tmpfs", "-o", "size=64m", "none", str(runs)), check=False)
    if mounted.returncode:
        pytest.skip("no file system can be mounted here")
    yield tmp_path
    subprocess.run(("umount", "-l", str(runs)), check=True)


def fill(file: Path) -> None:
    try:
        with file.open("wb", buffering=0) as stream:
            while stream.write(bytes(1 << 16)):
                pass
    except OSError:
        return


def test_full_disk_is_a_banner_until_there_is_room_and_stands_in_the_report(
    browser: Any, small: Path, opened: Opened, keep: Any
) -> None:
    night = Night(small)
    try:
        page, filler = opened(night.url), small / "runs" / "filler"
        page.wait_for_selector(".alarms", state="hidden")
        fill(filler)
        banner = ".alarms .flag:has-text('nothing can be recorded')"
        page.wait_for_selector(banner, timeout=40_000)
        keep(page, "full-disk")
        filler.unlink()
        page.wait_for_selector(banner, state="detached", timeout=40_000)
    finally:
        night.close()
    report = (night.folder / REPORT_FILE).read_text(encoding="utf-8")
    assert "<h2>Critical messages</h2>" in report
    assert "nothing can be recorded" in report
