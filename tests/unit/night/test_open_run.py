"""`open_run` on running, killed and damaged runs, and on folders without a run."""

from __future__ import annotations

import gc
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import pytest
from record_lab import ABOUT, Night
from temporary_folder import use_temporary_folder

import afspm
from afspm import wire
from afspm.basics.errors import FileError
from afspm.components.tip_verdict import BAD, GOOD, verdict_message
from afspm.model import Problem, Region, RegistrationOutcome, RescanKind, Scan, ScopeState, Spectrum
from afspm.night.bad_scans import VERDICT_MESSAGE
from afspm.night.overview import Overview
from afspm.night.run import Run
from afspm.record import journal
from afspm.record.journal import JOURNAL_FILE, open_to_write, read_only
from afspm.record.store import RecordStore


def test_running_record_is_read_up_to_now(night: Night, store: RecordStore, tmp_path: Path) -> None:
    run = afspm.open_run(tmp_path)
    assert len(run.scans) == 0
    store.take(night.whole_scan(1))
    assert len(run.scans) == 1
    assert run.scan(-1).first.filename == "scan-0001.nc"


def test_killed_run_is_readable(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take(night.whole_scan(1))
    left = tmp_path / "left"
    left.mkdir()
    for file in tmp_path.glob(f"{JOURNAL_FILE}*"):  # with all that was not yet put into the main file
        (left / file.name).write_bytes(file.read_bytes())
    assert len(afspm.open_run(left).scans) == 1


def test_run_that_is_opened_without_with_is_closed_in_silence(
    night: Night, store: RecordStore, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    store.take(night.whole_scan(1))
    assert len(afspm.open_run(tmp_path).scans) == 1
    with pytest.raises(sqlite3.OperationalError):
        journal._Reader(str(tmp_path / "missing" / JOURNAL_FILE))
    gc.collect()
    assert not recwarn.list


def test_copy_of_a_read_only_journal_is_removed_when_closed_or_collected(
    night: Night, store: RecordStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.take(night.whole_scan(1))
    copies = tmp_path / "copies"
    copies.mkdir()
    use_temporary_folder(copies, monkeypatch)
    opened = sqlite3.connect

    def connect(name: Any, **settings: Any) -> Any:
        if "copies" not in str(name):
            raise sqlite3.OperationalError("unable to open database file")
        return opened(name, **settings)

    monkeypatch.setattr(sqlite3, "connect", connect)
    with afspm.open_run(tmp_path) as run:
        assert len(run.scans) == 1
        assert len(list(copies.iterdir())) == 1
    assert not list(copies.iterdir())
    run = afspm.open_run(tmp_path)
    assert len(run.scans) == 1
    del run
    gc.collect()
    assert not list(copies.iterdir())
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    (damaged / JOURNAL_FILE).write_bytes(b"not a journal at all" * 100)
    with pytest.raises(FileError, match="damaged"):
        afspm.open_run(damaged)
    assert not list(copies.iterdir())


def test_reading_changes_nothing(night: Night, tmp_path: Path) -> None:
    store = RecordStore(tmp_path, ABOUT)
    store.take(night.whole_scan(1))
    store.close()
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    with afspm.open_run(tmp_path) as run:
        run.scan(0)
        run.overview()
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.suffix in (".sqlite", ".h5")} == before


def test_ended_journal_is_one_file_and_stays_one_when_read(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take(night.whole_scan(1))
    store.settle()
    store.close()
    with afspm.open_run(tmp_path) as run:
        assert len(run.scans) == 1
    assert [file.name for file in tmp_path.iterdir() if file.is_file()] == [JOURNAL_FILE]
    again = RecordStore(tmp_path, ABOUT)  # as a run that is resumed all the same
    again.take(night.whole_scan(2))
    assert len(afspm.open_run(tmp_path).scans) == 2
    again.close()


def test_reader_is_not_disturbed_by_the_end_of_the_run(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take(night.whole_scan(1))
    with afspm.open_run(tmp_path) as run:
        packets = iter(run.packets())
        next(packets)  # in the middle of it
        store.settle()
        assert len(list(packets)) == 3
        assert len(run.scans) == 1


def test_folder_of_runs_opens_the_newest_run(night: Night, tmp_path: Path) -> None:
    (tmp_path / "night-2").mkdir()
    RecordStore(tmp_path / "night-2", ABOUT).close()
    (tmp_path / "latest.txt").write_text("night-2\n")
    assert afspm.open_run(tmp_path).folder == tmp_path / "night-2"


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (r"C:\my runs\journal.sqlite", "file:///C:/my%20runs/journal.sqlite?mode=ro"),
        (r"\\nas\runs\journal.sqlite", "file:////nas/runs/journal.sqlite?mode=ro"),
    ],
)
def test_record_on_a_network_share_has_a_valid_uri(path: str, said: str, tmp_path: Path) -> None:
    assert read_only(PureWindowsPath(path)) == said
    if sys.platform == "win32":
        return  # there the form with four slashes is a share, which this computer may not have
    with closing(sqlite3.connect(tmp_path / JOURNAL_FILE)) as made:
        made.execute("CREATE TABLE about (name)")
    in_that_form = read_only(tmp_path / JOURNAL_FILE).replace("file:///", "file:////")
    with closing(sqlite3.connect(in_that_form, uri=True)) as opened:
        assert opened.execute("SELECT * FROM about").fetchall() == []


def test_folder_without_a_record_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no record") as caught:
        afspm.open_run(tmp_path)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"not a database at all" * 100, b"SQLite format 3\0" + bytes(500)])
def test_damaged_journal_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / JOURNAL_FILE).write_bytes(content)
    with pytest.raises(FileError) as caught:
        afspm.open_run(tmp_path)
    assert JOURNAL_FILE in str(caught.value)
    with pytest.raises((FileError, sqlite3.OperationalError)) if content else _nothing():
        RecordStore(tmp_path, ABOUT).close()


class _nothing:  # noqa: N801 - an empty file is a new journal to whoever writes
    def __enter__(self) -> None: ...
    def __exit__(self, *_: object) -> None: ...


def test_journal_with_table_names_that_are_no_text_is_damaged(tmp_path: Path) -> None:
    RecordStore(tmp_path, ABOUT).close()
    data = (tmp_path / JOURNAL_FILE).read_bytes()
    (tmp_path / JOURNAL_FILE).write_bytes(data.replace(b"CREATE TABLE packets", b"CREATE TABL\x98 packets"))
    with pytest.raises(FileError, match="is damaged"):
        afspm.open_run(tmp_path)
    with pytest.raises(FileError, match="is damaged"):
        open_to_write(tmp_path)


READINGS: dict[str, Callable[[Run], object]] = {
    "scans": lambda run: list(run.scans),
    "packets": lambda run: list(run.packets()),
    "overview": lambda run: run.overview(),
}


@pytest.mark.parametrize("reading", READINGS.values(), ids=READINGS)
def test_journal_damaged_inside_is_named_when_read(
    night: Night, tmp_path: Path, reading: Callable[[Run], object]
) -> None:
    store = RecordStore(tmp_path, ABOUT)
    for number in range(1, 40):
        store.take(night.whole_scan(number))
    store.close()
    data = bytearray((tmp_path / JOURNAL_FILE).read_bytes())
    data[8192:] = np.random.default_rng(1).bytes(len(data) - 8192)
    (tmp_path / JOURNAL_FILE).write_bytes(data)
    with pytest.raises(FileError, match=r"journal\.sqlite"):
        _open_and_read(tmp_path, reading)


def _open_and_read(folder: Path, reading: Callable[[Run], object]) -> None:
    with afspm.open_run(folder) as run:
        reading(run)


def test_journal_of_a_later_version_is_refused(tmp_path: Path) -> None:
    RecordStore(tmp_path, ABOUT).close()
    with sqlite3.connect(tmp_path / JOURNAL_FILE) as connection:
        connection.execute("UPDATE about SET value = 'afspm record 2' WHERE name = 'format'")
    connection.close()
    with pytest.raises(FileError, match="afspm record 2"):
        afspm.open_run(tmp_path)


def test_foreign_database_is_refused(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / JOURNAL_FILE) as connection:
        connection.execute("CREATE TABLE cats (name TEXT)")
    connection.close()
    with pytest.raises(FileError, match="not a journal"):
        afspm.open_run(tmp_path)


@pytest.mark.parametrize("content", [None, b"", b"\x89HDF\r\n\x1a\n" + bytes(100)])
def test_damaged_or_missing_file_of_a_scan_is_named(
    night: Night, store: RecordStore, tmp_path: Path, content: bytes | None
) -> None:
    store.take([*night.whole_scan(1), *night.whole_scan(2)])
    run = afspm.open_run(tmp_path)
    file = tmp_path / run.scans[0].file
    if content is None:
        file.unlink()
    else:
        file.write_bytes(content)
    with pytest.raises(FileError) as caught:
        run.scan(0)
    assert file.name in str(caught.value)
    assert len(run.scan(1)) == 2  # the others are there
    assert sum(packet.envelope.startswith("Scan2d") for packet in run.packets()) == 2


def test_half_a_file_is_named(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take(night.whole_scan(1))
    run = afspm.open_run(tmp_path)
    file = tmp_path / run.scans[0].file
    for part in (0.3, 0.6, 0.9):
        whole = file.read_bytes()
        file.write_bytes(whole[: int(len(whole) * part)])
        with pytest.raises(FileError, match=file.name):
            run.scan(0)
        file.write_bytes(whole)
    assert len(run.scan(0)) == 2


def test_there_is_no_scan_beyond_the_last(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take(night.whole_scan(1))
    run = afspm.open_run(tmp_path)
    for index in (1, -2):
        with pytest.raises(IndexError):
            run.scan(index)


def test_tables_become_arrays_and_datasets(night: Night, store: RecordStore, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    store.take([night.control(), *night.whole_scan(1)])
    store.take([night.state(ScopeState.SCANNING), night.state(ScopeState.INTERRUPTED)])
    run = afspm.open_run(tmp_path)
    found = run.scans.to_numpy()
    assert found["time_ns"].dtype == np.dtype("datetime64[ns]")
    assert found["center_x_m"][0] == 1e-6
    assert np.isnan(found["center_x_m"][1])
    assert list(found["rows"]) == [6, -1]
    assert list(found["interrupted"]) == [False, True]
    assert isinstance(run.control.to_xarray(), xarray.Dataset)
    assert run.scans[:1].to_xarray().sizes["row"] == 1
    assert [row.number for row in run.scans.where(lambda row: row.interrupted)] == [2]


def test_overview_reads_no_files(night: Night, store: RecordStore, tmp_path: Path) -> None:
    curve = Spectrum((1e-9, 2e-9), "IV", ("Bias", "Current"), ("V", "A"), np.ones((5, 2)), 3)
    store.take([night.control("series", (4,)), *night.whole_scan(1), night.packet(curve, "Spec1d_IV")])
    run = afspm.open_run(tmp_path)
    for row in (run.scans[0], run.spectra[0]):
        (tmp_path / row.file).unlink()
    overview = run.overview()
    assert [(one.kind, one.position_m, one.names) for one in overview.spectra] == [("IV", (1e-9, 2e-9), curve.names)]
    assert [(scan.channel, scan.shape) for scan in overview.scans] == [("Height", (6, 8)), ("Height Retrace", (6, 8))]
    assert [row.name for row in run.problems] == ["thermal-drift"]


def test_scan_rows_have_registration_and_uncertainty(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take(night.whole_scan(1))
    store.take(night.registered_scan(2, RegistrationOutcome.REGISTERED, 1e-9))
    store.take(night.registered_scan(3, RegistrationOutcome.FAILED, 30e-9))
    store.take(night.whole_scan(4))
    run = afspm.open_run(tmp_path)
    assert [(row.registration, row.position_sd_m) for row in run.scans] == [
        (None, None),
        (RegistrationOutcome.REGISTERED, pytest.approx(1e-9)),
        (RegistrationOutcome.FAILED, pytest.approx(30e-9)),
        (None, None),
    ]
    columns = run.scans.columns()
    assert columns["registration"] == [None, "registered", "failed", None]
    assert run.about(run.scans[2])["drift"]["registration"] == "failed"
    assert run.about(run.scans[2])["drift"]["sd_m"] == pytest.approx(30e-9)
    assert run.drift.columns()["outcome"] == ["registered", "failed"]


def test_scan_rows_have_the_last_verdict_on_the_tip(night: Night, store: RecordStore, tmp_path: Path) -> None:
    for number in (1, 2, 3):
        store.take(night.whole_scan(number))
    ends_ns = [row.time_ns for row in afspm.open_run(tmp_path).scans]
    for number, score in ((1, GOOD), (2, GOOD), (2, BAD)):
        later_ns = ends_ns[number - 1] + 1_000_000  # the channels of a scan need not end at the same time
        judged = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height Retrace", "m", np.zeros((2, 2)), later_ns)
        store.take([night.packet(verdict_message(judged, score), f"{VERDICT_MESSAGE}_judge")])
    scans = afspm.open_run(tmp_path).scans
    assert [row.tip_score for row in scans] == [1.0, 0.0, None]
    assert [row.number for row in scans.where(lambda row: row.tip_score != BAD)] == [1, 3]
    assert scans.columns()["tip_score"] == [1.0, 0.0, None]


def test_first_thermal_drift_is_not_among_the_problems(night: Night, store: RecordStore, tmp_path: Path) -> None:
    flagged = night.control("rescanner", (int(Problem.THERMAL_DRIFT),))
    asked: Any = wire.message_type("DriftRescan")(kind=int(RescanKind.OPPOSITE))
    asked.timestamp.FromNanoseconds(night.now_ns)
    store.take([flagged, night.packet(asked), *night.whole_scan(1), night.control("series")])
    assert not afspm.open_run(tmp_path).problems


def test_file_of_a_scan_outside_the_folder_of_the_run_is_refused(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    store.take(night.whole_scan(1))
    store.close()
    elsewhere = tmp_path.with_name(f"{tmp_path.name}-elsewhere.h5")
    with afspm.open_run(tmp_path) as run:
        elsewhere.write_bytes((tmp_path / run.scans[0].file).read_bytes())
    for named in (str(elsewhere), f"../{elsewhere.name}"):
        with closing(sqlite3.connect(tmp_path / JOURNAL_FILE)) as journal, journal:
            journal.execute("UPDATE scans SET file = ?", (named,))
        with afspm.open_run(tmp_path) as run:
            with pytest.raises(FileError, match="not in the folder of the run"):
                run.scan(-1)
            assert not [packet for packet in run.packets() if packet.envelope.startswith("Scan2d")]


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i FROM n"


@pytest.mark.parametrize(
    "statement",
    [
        f"CREATE VIEW scans AS {ENDLESS}",
        "CREATE VIRTUAL TABLE scans USING fts5(number)",
        "CREATE TRIGGER t AFTER INSERT ON log BEGIN SELECT 1; END",
    ],
)
def test_journal_with_anything_but_tables_is_refused(
    night: Night, store: RecordStore, tmp_path: Path, statement: str
) -> None:
    # a foreign journal could contain a view that never ends, which would block `afspm runs`
    store.take(night.whole_scan(1))
    store.close()
    with closing(sqlite3.connect(tmp_path / JOURNAL_FILE)) as journal, journal:
        if "scans" in statement:
            journal.execute("DROP TABLE scans")
        journal.execute(statement)
    with pytest.raises(FileError, match="is not a table"):
        afspm.open_run(tmp_path)


def test_page_and_record_number_scans_alike_after_interruptions(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    scanning, interrupted, free = ScopeState.SCANNING, ScopeState.INTERRUPTED, ScopeState.FREE
    page = Overview()
    for given in (
        [night.control(), night.state(free)],
        night.whole_scan(1),
        [night.state(scanning), night.state(interrupted), night.state(free)],  # before its first line
        night.whole_scan(2),
        [night.state(scanning), night.lines(2), night.state(interrupted), night.state(free)],
        night.whole_scan(3),
    ):
        store.take(given)
        for packet, _ in given:
            message = wire.message_of(packet.envelope)
            page.take(message, wire.decode(message, packet.payload), packet.time_ns or 0, packet.envelope)
    run = afspm.open_run(tmp_path)
    numbers = {row.filename: row.number for row in run.scans if row.filename}
    past = run.overview([one.name for one in wire.declared() if one.in_past])  # as of a restarted page
    assert list(numbers.values()) == [1, 3, 5]
    assert [row.number for row in run.scans] == [1, 2, 3, 4, 5]
    for overview in (page, past, run.overview()):
        assert {one.filename: one.number for one in overview.scans if one.filename} == numbers
        assert overview.scan_count == 5


def test_wrong_path_of_a_run_has_its_reason(tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text("")
    for name, reason in {"night.toml": "this is a file", "absent": "no such folder", ".": "no record in this"}.items():
        with pytest.raises(FileError, match=reason):
            afspm.open_run(tmp_path / name)
