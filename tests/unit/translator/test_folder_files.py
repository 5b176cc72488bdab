"""Files of scans that follow each other at a panel, before the file of the first is complete."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import numpy as np
import pytest

from afspm.model import Region, Scan
from afspm.storage.formats import FileContent
from afspm.translator.folder_files import FolderFiles
from afspm.translator.result_files import SCAN, FilePrecision
from afspm.translator.setting_groups import as_list

FRAME = Region((0.0, 0.0), (1e-6, 1e-6), 0.0)
TAKEN = {"frame": as_list(FRAME)}
WITHIN_S = 10.0
LAST_NS = 9 * 10**9


class OneRowFiles(FolderFiles):
    """Files whose only content is the length of a scan's only row."""

    precision = FilePrecision(part=1e-9, angle_rad=1e-9)

    def content_of(self, path: Path) -> FileContent:
        values = np.zeros((1, int(path.read_text(encoding="utf-8"))))
        return FileContent("test", (Scan(FRAME, "Z", "m", values, filename=str(path)),))


@pytest.fixture
def files(tmp_path: Path) -> OneRowFiles:
    """Return the files of a scan that has ended without a file, and of the next, which runs."""
    found = OneRowFiles({}, logging.getLogger("test"))
    found.begin(SCAN, tmp_path, TAKEN)
    found.end(10**9)
    return found


def save(folder: Path, number: int) -> str:
    path = folder / f"{number}"
    path.write_text("4", encoding="utf-8")
    os.utime(path, ns=(number * 10**9, number * 10**9))
    return str(path)


def look(files: OneRowFiles, now_s: float) -> tuple[list[str], bool | None]:
    """Return the results and the outcome of a scan that was followed, as at a look of the translator."""
    now_ns = round(now_s * 1e9)
    return files.results(now_ns), files.followed(now_ns, WITHIN_S)


def test_late_file_belongs_to_the_scan_before_and_the_next_one_has_its_own(files: OneRowFiles, tmp_path: Path) -> None:
    assert files.next_begins()
    files.begin(SCAN, tmp_path, TAKEN)
    assert look(files, 2.0) == ([], None)
    first = save(tmp_path, 1)
    assert look(files, 3.0) == ([], None), "it may be of the next scan, if that has just ended"
    assert look(files, 3.5) == ([first], True)
    assert look(files, 4.0) == ([first], None)
    files.end(5 * 10**9)
    assert look(files, 6.0) == ([first], None)
    second = save(tmp_path, 2)
    assert look(files, 7.0) == ([first, second], None)


def test_file_there_when_the_next_scan_begins_is_not_lost(files: OneRowFiles, tmp_path: Path) -> None:
    first = save(tmp_path, 1)
    assert files.next_begins()
    files.begin(SCAN, tmp_path, TAKEN)
    assert look(files, 2.0) == ([], None)
    assert look(files, 2.5) == ([first], True)


def test_file_saved_between_the_state_and_the_files_of_a_look_belongs_to_the_scan_that_ended(
    files: OneRowFiles, tmp_path: Path
) -> None:
    assert files.next_begins()
    files.begin(SCAN, tmp_path, TAKEN)
    second = save(tmp_path, 9)
    assert look(files, 2.0) == ([], None), "the state was read before the end"
    files.end(2 * 10**9)
    assert look(files, 2.5) == ([], False), "the scan before has no file"
    assert look(files, 3.0) == ([], None)
    assert look(files, 3.5) == ([second], None)


@pytest.mark.parametrize(("ends_next", "at_s"), [(True, 2.0), (False, 1.0 + WITHIN_S)])
def test_scan_without_a_file_was_interrupted(files: OneRowFiles, tmp_path: Path, ends_next: bool, at_s: float) -> None:
    assert files.next_begins()
    files.begin(SCAN, tmp_path, TAKEN)
    assert look(files, at_s - 0.5) == ([], None)
    if ends_next:
        files.end(2 * 10**9)
    second = save(tmp_path, 9) if ends_next else ""
    assert look(files, at_s) == ([], False)
    assert files.results(LAST_NS) == [], "listed in the same look, it would be discarded with what was interrupted"
    assert look(files, at_s) == ([], None)
    if not ends_next:
        files.end(LAST_NS)
        second = save(tmp_path, 9)
    assert look(files, 60.0) == ([second], None)


def test_forgotten_scan_awaits_nothing(files: OneRowFiles, tmp_path: Path) -> None:
    files.forget()
    assert not files.next_begins()
    files.begin(SCAN, tmp_path, TAKEN)
    assert look(files, 60.0) == ([], None)
