"""A file that is saved often survives a kill unchanged, and a power cut in the state of a moment before."""

from __future__ import annotations

import errno
import json
import logging
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from afspm.basics.errors import FileError
from afspm.model import ControlMode, LogLine
from afspm.scheduler.control.arbitration import ArbitrationState
from afspm.scheduler.saved_state import SavedState
from afspm.scheduler.write_ahead import StateFile
from afspm.storage import atomic
from afspm.storage.atomic import SLOW_S, CheckpointFile, OutageLog, load_checkpoint, previous_generation
from afspm.storage.disk import SYNCER, DiskBacklogFull, DiskTimeout
from afspm.storage.memory import Memory

CUT = [b"", b"\0" * 40, b'{"control": {"mo']
"""What a power cut may leave of a file that was not synced."""


def saved(path: Path, *contents: bytes) -> None:
    """Save contents one after the other, each synced."""
    for content in contents:
        kept = CheckpointFile(path)
        kept.save(content)
        kept.close()


def number(content: bytes) -> int:
    return int(content)


def test_last_generation_is_read(tmp_path: Path) -> None:
    path = tmp_path / "state" / "x"
    saved(path, b"1", b"2")
    assert load_checkpoint(path, number) == (2, "")


def test_closed_checkpoint_has_two_copies(tmp_path: Path) -> None:
    path = tmp_path / "x"
    kept = CheckpointFile(path)
    for n in range(50):
        kept.save(b"%d" % n)
    kept.close()
    kept.close()
    assert (path.read_bytes().splitlines()[-1], previous_generation(path).read_bytes()) == (b"49", b"49\n")


def test_closed_memory_leaves_no_thread_and_can_be_saved_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("afspm.storage.memory.DEADLINE_S", 60.0)  # a busy computer is no disk that hangs
    before = {*threading.enumerate()}
    path = tmp_path / "state.json"
    memory = Memory(path, synced=False)
    for count in range(2):
        memory["count"] = count
        assert memory.save()
        memory.close()
        # the syncer is one for the process, and closes nothing
        assert not {one.name for one in {*threading.enumerate()} - before} - {"syncer"}
        assert json.loads(previous_generation(path).read_bytes()) == {"count": count}


def test_long_checkpoint_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "x"
    kept = CheckpointFile(path, longest=10)
    for n in range(10, 50):
        kept.save(b"%d" % n)
        assert load_checkpoint(path, number) == (n, "")
        assert path.stat().st_size <= 10
    kept.close()


def test_generation_before_half_a_generation_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x"
    kept = CheckpointFile(path, period_s=100.0)
    for text in (b"{}", b'{"a": 1}', b'{"a": 2}'):
        kept.save(text)
    kept.close()
    path.write_bytes(path.read_bytes()[:-4])
    value, damage = load_checkpoint(path, json.loads)
    assert value == {"a": 1}
    assert damage


@pytest.mark.skipif(sys.platform == "win32", reason="an open file can't be removed there")
def test_removed_file_is_written_again_with_the_next_generation(tmp_path: Path) -> None:
    path = tmp_path / "x"
    kept = CheckpointFile(path)
    kept.save(b"1")
    path.unlink()
    kept.save(b"2")
    kept.close()
    assert load_checkpoint(path, number) == (2, "")


@pytest.mark.skipif(sys.platform == "win32", reason="no limit on the size of files")
def test_full_disk_keeps_the_generation_before(tmp_path: Path) -> None:
    script = """
import resource, signal, sys
from pathlib import Path
from afspm.basics.errors import FileError
from afspm.storage.atomic import CheckpointFile, load_checkpoint
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
path = Path(sys.argv[1])
kept = CheckpointFile(path)
saved = failed = 0
while failed < 3:
    try:
        kept.save(b"%d" % (10**20 + saved))
        saved += 1
    except FileError:
        failed += 1
    assert load_checkpoint(path, int) == (10**20 + saved - 1, "")
print(saved)
"""
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path / "x")], capture_output=True, encoding="utf-8")
    assert (done.stdout.strip(), done.stderr) == ("270", ""), "after each failure it is tried to begin the file anew"


def test_previous_generation_is_synced_in_the_background(tmp_path: Path) -> None:
    path = tmp_path / "x"
    kept = CheckpointFile(path, period_s=0.001)
    n = 0
    while not previous_generation(path).exists() or int(previous_generation(path).read_bytes()) < 5:
        n += 1
        kept.save(b"%d" % n)
    kept.close()


class Reader:
    """A reader that keeps a file open for some tries, which only Windows minds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, tries: int) -> None:
        self.left = tries
        rename = Path.replace

        def replace(source: Path, target: Path) -> Path:
            self.left -= 1
            if self.left >= 0:
                raise PermissionError(13, "Access is denied", str(target))
            return rename(source, target)

        monkeypatch.setattr(Path, "replace", replace)
        monkeypatch.setattr(atomic, "_AGAIN_S", 0.0)
        monkeypatch.setattr(sys, "platform", "win32")


def test_file_open_for_a_moment_is_replaced_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = Reader(monkeypatch, tries=3)
    atomic.replace_file(tmp_path / "x", [b"1"], synced=False)
    assert (tmp_path / "x").read_bytes() == b"1"
    assert reader.left == -1


def test_file_that_stays_open_is_reported_and_no_temporary_file_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Reader(monkeypatch, tries=1000)
    with pytest.raises(FileError, match="Access is denied"):
        atomic.write_atomic(tmp_path / "x", [b"1"], synced=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("left", CUT)
def test_earlier_generation_after_a_power_cut_is_read_and_reported(tmp_path: Path, left: bytes) -> None:
    path = tmp_path / "x"
    saved(path, b"1")
    path.write_bytes(left)
    value, damage = load_checkpoint(path, number)
    assert value == 1
    assert damage


def test_two_unreadable_generations_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x"
    saved(path, b"1")
    path.write_bytes(b"")
    previous_generation(path).write_bytes(b"")
    with pytest.raises(FileError, match="delete it"):
        load_checkpoint(path, number)


def test_first_generation_lost_in_a_power_cut_counts_as_no_file(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"")
    assert load_checkpoint(path, number) == (None, "")


def test_unreadable_text_without_an_earlier_generation_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"half a num")
    with pytest.raises(FileError, match="delete it"):
        load_checkpoint(path, number)


def test_removed_checkpoint_starts_empty(tmp_path: Path) -> None:
    path = tmp_path / "x"
    saved(path, b"1")
    SYNCER.now(10.0)  # it is open until it is synced
    path.unlink()
    assert load_checkpoint(path, number) == (None, "")


@pytest.mark.parametrize("left", CUT)
def test_scheduler_after_a_power_cut_keeps_problems_and_gives_no_control(
    tmp_path: Path, left: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    log = logging.getLogger("scheduler")
    path = tmp_path / "scheduler.json"
    control = ArbitrationState(ControlMode.AUTOMATED, "series", solving=3, problems={3: "a"})
    saved = SavedState(control, granted_to="token", last_ns=7)
    file = StateFile(path, log)
    file.save(saved)
    file.close()
    assert StateFile(path, log).load() == saved
    assert not caplog.records
    path.write_bytes(left)
    assert StateFile(path, log).load() == saved.without_holder()
    assert saved.without_holder().control.holder is None
    assert "no component in control" in caplog.text


def test_checkpoint_without_a_sync_has_a_generation_before(tmp_path: Path) -> None:
    memory = Memory(tmp_path / "microscope.json", synced=False)
    memory["tip"] = "blunt"
    memory.save()
    assert memory._generations is not None
    memory._generations.close()
    assert (
        Memory(tmp_path / "microscope.json").damage,
        json.loads(previous_generation(tmp_path / "microscope.json").read_bytes()),
    ) == (
        "",
        {"tip": "blunt"},
    )
    (tmp_path / "microscope.json").write_bytes(b"")
    again = Memory(tmp_path / "microscope.json", synced=False)
    assert again["tip"] == "blunt"
    assert again.damage


class Outage:
    """An OutageLog, its clock, and the lines that it logged."""

    def __init__(self, caplog: pytest.LogCaptureFixture) -> None:
        self.now_s = 100.0
        self._log = OutageLog("a crash would lose this", logging.getLogger("test"), lambda: self.now_s)
        self._caplog = caplog
        caplog.set_level(logging.INFO, "test")

    def write(self, error: Exception | None = None) -> None:
        with self._log.trying():
            if error is not None:
                raise error

    @property
    def lines(self) -> list[tuple[str, str]]:
        return [(record.levelname, record.getMessage()) for record in self._caplog.records]


@pytest.fixture
def outage(caplog: pytest.LogCaptureFixture) -> Outage:
    return Outage(caplog)


def test_a_disk_that_is_busy_for_a_moment_is_not_logged(outage: Outage) -> None:
    for late_s in (0.0, 1.0, SLOW_S - 0.1):
        outage.now_s = 100.0 + late_s
        outage.write(DiskTimeout())
    outage.write()
    outage.now_s += 1.0
    outage.write(DiskTimeout())  # another moment, counted from its own beginning
    assert outage.lines == []


def test_a_disk_that_is_slow_is_one_warning_with_how_long(outage: Outage) -> None:
    for late_s in (0.0, SLOW_S, 8.0, 11.0):
        outage.now_s = 100.0 + late_s
        outage.write(DiskTimeout())
    outage.now_s = 112.0
    outage.write()
    assert outage.lines == [
        ("WARNING", "a crash would lose this: the disk has not answered for 3 s"),
        ("INFO", "writing works again; the disk had not answered for 12 s; no longer true: a crash would lose this"),
    ]


@pytest.mark.parametrize("error", [DiskBacklogFull(), OSError(errno.ENOSPC, "No space left"), FileError("is gone")])
def test_data_that_are_never_written_are_critical_at_once(outage: Outage, error: Exception) -> None:
    outage.write(error)
    outage.write(error)
    outage.write()
    critical, over = (LogLine(1, "series", *line) for line in outage.lines)
    assert (critical.level, over.level) == ("CRITICAL", "INFO")
    assert over.ends(critical)


def test_a_slow_disk_that_then_refuses_to_write_is_critical_too(outage: Outage) -> None:
    outage.write(DiskTimeout())
    outage.now_s += SLOW_S
    outage.write(DiskTimeout())
    outage.write(OSError(errno.EIO, "Input/output error"))
    assert [level for level, _ in outage.lines] == ["WARNING", "CRITICAL"]
