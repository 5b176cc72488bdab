"""The history of a probe is added up over all runs with its name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from record_lab import ABOUT, REGION, Night
from typer.testing import CliRunner

from afspm.cli.app import app
from afspm.model import ControlRequest, ControlResponse, JournalEntries, JournalEntry, ScopeState
from afspm.night.catalogue import UNNAMED, find_runs, probe_histories
from afspm.record.run_json import RUN_FILE
from afspm.record.store import RecordStore

SCAN_M = 2 * 6 * REGION.size_m[0]


def action(night: Night, name: str, response: ControlResponse = ControlResponse.SUCCESS) -> JournalEntry:
    return JournalEntry(night.now_ns, "request", "repair", name, int(response), request=int(ControlRequest.ACTION))


def record(folder: Path, days: int, **metadata: str) -> None:
    """Make a run with a whole scan, a third of a scan, two pulses, and a refused one."""
    folder.mkdir(parents=True)
    (folder / RUN_FILE).write_text(json.dumps({"name": folder.name, "metadata": metadata}), encoding="utf-8")
    night, store = Night(), RecordStore(folder, ABOUT)
    night.now_ns += days * 86_400_000_000_000
    done = [action(night, "start-scan"), action(night, "x-pulse"), action(night, "x-pulse")]
    refused = action(night, "x-crash", ControlResponse.ACTION_ERROR)
    store.take([night.control("series"), *night.whole_scan(1), night.packet(JournalEntries((*done, refused)))])
    store.take([night.state(ScopeState.SCANNING), night.lines(2), night.state(ScopeState.INTERRUPTED)])
    store.close()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    record(tmp_path / "monday", 0, probe="NCHR 7")
    record(tmp_path / "tuesday", 1, probe="NCHR 7")
    record(tmp_path / "wednesday", 2)
    return tmp_path


def test_probe_used_last_comes_first_and_runs_are_added_up(root: Path) -> None:
    unnamed, probe = probe_histories(find_runs(root))
    assert (unnamed.name, unnamed.runs) == (UNNAMED, ("wednesday",))
    assert (probe.name, probe.runs) == ("NCHR 7", ("monday", "tuesday"))
    assert probe.scans == 2
    assert probe.treatments == {"x-pulse": 4}
    assert probe.first_ns is not None
    assert probe.last_ns is not None
    assert probe.last_ns - probe.first_ns >= 86_400_000_000_000


def test_lines_of_an_interrupted_scan_count_as_far_as_they_were_taken(root: Path) -> None:
    histories = {probe.name: probe for probe in probe_histories(find_runs(root))}
    assert histories[UNNAMED].scanned_m == pytest.approx(SCAN_M + SCAN_M * 2 / 6)


def test_runs_are_chosen_by_the_name_of_the_probe(root: Path) -> None:
    assert [probe.name for probe in probe_histories(find_runs(root, ["probe:nchr"]))] == ["NCHR 7"]


def test_damaged_run_is_left_out(root: Path) -> None:
    (root / "wednesday" / "journal.sqlite").write_bytes(b"no database" * 100)
    assert [probe.name for probe in probe_histories(find_runs(root))] == ["NCHR 7"]


def test_command_lists_probes_and_gives_json(root: Path) -> None:
    table = CliRunner().invoke(app, ["probes", "--in", str(root)], env={"COLUMNS": "220"}).output
    assert "NCHR 7" in table
    assert "4 × x-pulse" in table
    (only,) = json.loads(CliRunner().invoke(app, ["probes", "probe:nchr", "--in", str(root), "--json"]).output)
    assert (only["name"], only["runs"]) == ("NCHR 7", ["monday", "tuesday"])
