"""Notes in the record: on scans and moments, during the run and after its end."""

from __future__ import annotations

import csv
from pathlib import Path

import h5py
import pytest
from record_lab import Night

import afspm
from afspm.basics.errors import FileError, InvalidValue
from afspm.model import JournalEntry, Note
from afspm.night.notes import append_note
from afspm.record.run_json import STATE_DIR
from afspm.record.run_lock import lock_run
from afspm.record.store import RecordStore
from afspm.report.export import export
from afspm.report.night_report import write

HOSTILE = '<script>alert("x")</script> & "tip", changed\nhere'


@pytest.fixture
def noted(night: Night, store: RecordStore, tmp_path: Path) -> Path:
    """A record of two scans, with a note on the second and one on a moment."""
    store.take([night.control(), *night.whole_scan(1), *night.whole_scan(2)])
    with afspm.open_run(tmp_path) as run:
        second = run.scans[1]
    store.take([night.packet(Note(second.time_ns, "terminal:ada", HOSTILE, second.time_ns, night.now_ns))])
    store.take([night.packet(Note(second.time_ns - 1, "survey", "the door slammed", None, night.now_ns))])
    store.finish()
    return tmp_path


def test_notes_are_ordered_by_their_moments_and_name_their_scan(noted: Path) -> None:
    with afspm.open_run(noted) as run:
        assert [(note.who, note.text, note.scan) for note in run.notes] == [
            ("survey", "the door slammed", None),
            ("terminal:ada", HOSTILE, 2),
        ]
        assert [note.text for note in run.notes_on(run.scans[1])] == [HOSTILE]
        assert not run.notes_on(run.scans[0])
        assert [note.text for note in run.overview().notes] == [HOSTILE, "the door slammed"]


def test_journal_has_each_note_once(noted: Path) -> None:
    with afspm.open_run(noted) as run:
        entries = [entry for entry in run.journal if entry.kind == "note"]
        assert entries[1] == JournalEntry(run.scans[1].time_ns, "note", "terminal:ada", HOSTILE)
        assert len(entries) == 2
        assert not run.refusals


def test_exports_have_the_notes(noted: Path, tmp_path: Path) -> None:
    with afspm.open_run(noted) as run:
        plain, with_note = (path for path in export(run, "h5", tmp_path / "h5") if path.suffix == ".h5")
        files = {to: list(export(run, to, tmp_path / to, "2")) for to in ("gwy", "nc", "csv")}
    with h5py.File(plain) as file:
        assert not [name for name in file["entry"] if name.startswith("note")]
    with h5py.File(with_note) as file:
        note = file["entry/note_1"]
        assert note.attrs["NX_class"] == "NXnote"
        assert (note["author"][()], note["description"][()]) == (b"terminal:ada", HOSTILE.encode())
    assert afspm.read(with_note).scans
    for to in ("gwy", "nc"):
        assert b"tip" in files[to][0].read_bytes()
    with (tmp_path / "csv" / "notes.csv").open(newline="", encoding="utf-8") as table:
        assert [row["text"] for row in csv.DictReader(table)] == ["the door slammed", HOSTILE]


def test_report_shows_notes_with_escaped_markup(noted: Path) -> None:
    html = write(noted).read_text(encoding="utf-8")
    assert "<script>" not in html
    assert "&lt;script&gt;alert(&quot;x&quot;)" in html
    assert "the door slammed" in html
    assert 'class="marked"' in html


def test_note_after_the_end_is_appended_in_the_published_form(noted: Path, store: RecordStore) -> None:
    store.settle()
    store.close()
    with afspm.open_run(noted) as run:
        end_ns, first = run.newest_ns, run.numbered(1)
    append_note(noted, "terminal:ada", "double tip", 7, first.time_ns)
    append_note(noted, "terminal:ada", "a good night", 8)
    with afspm.open_run(noted) as run:
        new = [note for note in run.notes if note.text in ("double tip", "a good night")]
        assert [(note.scan, note.written_ns) for note in new] == [(1, 7), (None, 8)]
        assert new[1].time_ns >= end_ns
        assert len(run.journal.where(lambda entry: entry.kind == "note")) == 4
        assert len(list(run.packets(messages=("Note",)))) == 4
        assert run.facts == {}
        assert run.simulated  # what the record said of the run is as it was
    assert not list(noted.glob("journal.sqlite-*"))


def test_running_record_refuses_appended_notes(noted: Path) -> None:
    (noted / STATE_DIR).mkdir()
    with lock_run(noted), pytest.raises(FileError, match="still going on"):
        append_note(noted, "terminal:ada", "double tip", 7)
    with afspm.open_run(noted) as run:
        assert len(run.notes) == 2


@pytest.mark.parametrize("text", ["", "  \n", "x" * 1001, "\x1b[2J", "a\0b", "\ud800"])
def test_note_without_text_too_long_or_with_control_characters_is_refused(text: str) -> None:
    with pytest.raises(InvalidValue):
        Note(1, "ada", text)


def test_unknown_scan_number_is_refused(noted: Path) -> None:
    with afspm.open_run(noted) as run, pytest.raises(InvalidValue, match="no scan 3"):
        run.numbered(3)
