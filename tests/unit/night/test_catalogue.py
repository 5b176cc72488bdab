"""The catalogue of all runs under a folder: listed, searched, and read again only after a change."""

from __future__ import annotations

import json
import os
import sqlite3
from contextlib import closing
from datetime import date
from pathlib import Path
from typing import Any

import pytest
from record_lab import ABOUT, Night
from typer.testing import CliRunner

from afspm.basics.errors import FileError, InvalidValue
from afspm.cli.app import app
from afspm.night.catalogue import INDEX_FILE, find_runs
from afspm.record.journal import JOURNAL_FILE
from afspm.record.run_json import RUN_FILE
from afspm.record.store import RecordStore

METADATA: dict[str, Any] = {
    "sample": "Au(111) on mica",
    "person": "A. Student",
    "vendor": "SPECS Zurich",
    "microscope": "Tyto",
}


def record(folder: Path, problems: tuple[int, ...] = (), **metadata: str) -> Path:
    """Make a run with one scan on 2026-03-14."""
    folder.mkdir(parents=True)
    (folder / RUN_FILE).write_text(json.dumps({"name": folder.name, "metadata": metadata}), encoding="utf-8")
    add_scan(folder, problems)
    return folder


def add_scan(folder: Path, problems: tuple[int, ...] = (), number: int = 1) -> None:
    night, store = Night(), RecordStore(folder, ABOUT)
    night.now_ns += number * 1_000_000_000
    store.take([night.control("series", problems), *night.whole_scan(number)])
    store.close()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    record(tmp_path / "gold-1", **METADATA)
    record(tmp_path / "spring" / "mica-1", problems=(1,), sample="mica", person="B. Student")
    return tmp_path


def names(root: Path, *words: str) -> list[str]:
    return sorted(run.folder for run in find_runs(root, words))


def test_catalogue_lists_every_run_with_its_facts(root: Path) -> None:
    gold, mica = sorted(find_runs(root), key=lambda run: run.folder)
    assert (gold.folder, gold.scans, gold.metadata["sample"], gold.microscope) == (
        "gold-1",
        1,
        METADATA["sample"],
        "SPECS Zurich Tyto",
    )
    assert (mica.folder, mica.problems) == ("spring/mica-1", ("tip-shape-changed",))
    assert gold.began_ns is not None


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["mica"], ["gold-1", "spring/mica-1"]),
        (["sample:AU"], ["gold-1"]),
        (["mica", "person:b."], ["spring/mica-1"]),
        (["problem:tip"], ["spring/mica-1"]),
        (["silicon"], []),
    ],
)
def test_words_select_runs(root: Path, words: list[str], found: list[str]) -> None:
    assert names(root, *words) == found


@pytest.mark.parametrize("channels", ["no JSON", "[" * 100_000, "7"])
def test_damaged_run_hides_no_other(root: Path, channels: str) -> None:
    with sqlite3.connect(root / "gold-1" / JOURNAL_FILE) as journal:
        journal.execute("UPDATE scans SET channels = ?", (channels,))
    journal.close()
    damaged, whole = sorted(find_runs(root), key=lambda run: run.folder)
    assert (damaged.name, whole.scans) == ("gold-1", 1)
    assert "is damaged" in (damaged.damage or "")


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000])
def test_nested_facts_of_a_run_hide_no_other(root: Path, text: str) -> None:
    (root / "gold-1" / RUN_FILE).write_text(text, encoding="utf-8")
    assert {run.folder for run in find_runs(root)} == {"gold-1", "spring/mica-1"}


def test_days_select_runs(root: Path) -> None:
    day, next_day = date(2026, 3, 14), date(2026, 3, 15)
    assert len(find_runs(root, since=day, until=day)) == 2
    assert find_runs(root, since=next_day) == find_runs(root, until=date(2026, 3, 13)) == []


def test_run_without_a_component_in_control_is_found_by_its_day(tmp_path: Path) -> None:
    folder = tmp_path / "by-hand"
    folder.mkdir()
    (folder / RUN_FILE).write_text("{}", encoding="utf-8")
    store = RecordStore(folder, ABOUT)
    store.take(Night().whole_scan(1))
    store.close()
    day = date(2026, 3, 14)
    assert [run.folder for run in find_runs(tmp_path, since=day, until=day)] == ["by-hand"]


def test_only_changed_runs_are_read_again(root: Path) -> None:
    find_runs(root)
    journal = root / "spring" / "mica-1" / JOURNAL_FILE
    found = journal.stat()
    journal.write_bytes(b"x" * found.st_size)  # a reader finds it damaged
    os.utime(journal, ns=(found.st_atime_ns, found.st_mtime_ns))
    add_scan(root / "gold-1", number=2)
    assert {run.folder: run.scans for run in find_runs(root)} == {"gold-1": 2, "spring/mica-1": 1}
    os.utime(journal)
    assert [run.folder for run in find_runs(root) if run.scans] == ["gold-1"]


def test_damaged_or_outdated_index_is_rebuilt(root: Path) -> None:
    (root / INDEX_FILE).write_bytes(b"no database" * 1000)
    assert len(find_runs(root)) == 2
    with sqlite3.connect(root / INDEX_FILE) as index:
        index.execute("PRAGMA user_version = 99")
    index.close()
    assert len(find_runs(root)) == 2


def test_deleted_run_is_dropped_and_a_damaged_one_is_named(root: Path) -> None:
    find_runs(root)
    (root / "gold-1").rename(root.parent / "elsewhere")
    (root / "spring" / "mica-1" / "journal.sqlite").write_bytes(b"x" * 5000)
    (run,) = find_runs(root)
    assert (run.folder, run.name) == ("spring/mica-1", "mica-1")
    assert "damaged" in run.damage


def test_runs_are_found_without_a_writable_index(root: Path) -> None:
    (root / INDEX_FILE).mkdir()
    assert len(find_runs(root)) == 2


def test_invalid_search_is_refused(root: Path) -> None:
    with pytest.raises(InvalidValue, match="no 'colour' to look in"):
        find_runs(root, ["colour:red"])
    with pytest.raises(FileError, match="no such folder"):
        find_runs(root / "nowhere")


def test_page_has_a_card_with_pictures_for_each_run(root: Path) -> None:
    (root / "gold-1" / "report.html").write_text("", encoding="utf-8")
    done = CliRunner().invoke(app, ["runs", "--in", str(root), "--page"])
    assert done.exit_code == 0
    text = (root / "index.html").read_text(encoding="utf-8")
    assert text.count("<article>") == 2
    assert text.count('<img src="data:image') == 2
    assert 'href="gold-1/report.html"' in text
    assert 'href="spring/mica-1/"' in text
    assert "Au(111) on mica" in text


def test_terminal_omits_empty_columns(root: Path) -> None:
    shown = CliRunner().invoke(app, ["runs", "--in", str(root), "person:a."]).stdout
    assert "gold-1" in shown
    assert "problems" not in shown
    told = json.loads(CliRunner().invoke(app, ["runs", "--in", str(root), "--json"]).stdout)
    assert {run["folder"] for run in told} == {"gold-1", "spring/mica-1"}


def test_foreign_index_is_rebuilt(root: Path) -> None:
    find_runs(root)
    with closing(sqlite3.connect(root / INDEX_FILE)) as index, index:
        index.execute("DROP TABLE runs")
        endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i, i, i FROM n"
        index.execute(f"CREATE VIEW runs (folder, stamp, about) AS {endless}")
    assert find_runs(root)


def test_search_takes_a_path_as_text_and_refuses_one_text_as_a_list(tmp_path: Path) -> None:
    assert find_runs(str(tmp_path), ["gold"]) == []
    with pytest.raises(InvalidValue, match="words must be a list of texts, not 'gold'"):
        find_runs(tmp_path, "gold")
