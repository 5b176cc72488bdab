"""The store records each packet once, complete, with its provenance."""

from __future__ import annotations

import json
import os
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from record_lab import ABOUT, REGION, START_NS, Given, Night, same
from small_disk import file_limit
from watched_disk import lossy_disk

import afspm
from afspm import wire
from afspm.basics.errors import FileError
from afspm.model import (
    ChannelRoles,
    Frame,
    InstrumentReading,
    InstrumentReadings,
    JournalEntries,
    JournalEntry,
    LogLine,
    Packet,
    ProblemNames,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Scan,
    ScopeState,
    Spectrum,
)
from afspm.model.events import LogLines
from afspm.model.variables import VariableRoles
from afspm.record.journal import JOURNAL_FILE
from afspm.record.run_json import EXPERIMENT_FILE
from afspm.record.store import _PROCESS, RecordSettings, RecordStore
from afspm.report import night_report as report
from afspm.storage import formats
from afspm.storage.formats import read


def test_scan_is_one_file_with_all_channels_and_its_provenance(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    given = [night.control("series", (1,)), night.feedback(), night.state(ScopeState.FREE), *night.whole_scan(1)]
    store.take(given)
    run = afspm.open_run(tmp_path)
    (row,) = run.scans
    assert (row.holder, row.mode, row.problems) == ("series", "automated", ("tip-shape-changed",))
    assert (row.channels, row.shape) == ((("Height", "m"), ("Height Retrace", "m")), (6, 8))
    assert row.began_ns == given[3][0].time_ns
    assert row.file == "scans/20260314T200000_004000Z-00001.h5"
    for packet, _ in given[4:6]:
        scan = wire.decode("Scan2d", packet.payload)
        assert np.array_equal(run.scan(0)[scan.channel].values, scan.values)
        assert run.scan(0)[scan.channel].region == scan.region
    about = run.about(row)
    assert about["feedback"] == {"on": True, "proportional_gain": 0.125, "integral_gain": 1500.0, "setpoint": 0.75}
    assert (about["experiment"], about["seeds"], about["simulated"]) == ("night", {"microscope": 7}, True)


def test_roles_of_channels_are_kept_and_the_topography_is_first(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    roles = ChannelRoles({"height": ("Topo",), "current": ("Current",)}).with_topography(feedback_on=True)
    store.take([night.packet(roles)])
    again = RecordStore(tmp_path, ABOUT)  # in another life, which gets the roles again from the cache
    packets = night.scan_in_files(1, ("Current", "Topo"))
    again.take([night.packet(roles), night.state(ScopeState.SCANNING), *packets, night.state(ScopeState.FREE)])
    again.close()
    run = afspm.open_run(tmp_path)
    assert [name for name, _ in run.scans[0].channels] == ["Topo", "Current"]
    scans = run.scan(0)
    assert (scans["topography"].channel, scans["height"].channel, scans["current"].channel) == (
        "Topo",
        "Topo",
        "Current",
    )
    assert run.about(run.scans[0])["channels"][0]["roles"] == ["height", "topography"]


def test_roles_of_variables_are_kept_in_the_file(night: Night, store: RecordStore, tmp_path: Path) -> None:
    roles = VariableRoles.declared({"height": ("Z",), "force": ("F",), "force, retrace": ("F back",)}, towards=("Z",))
    values = np.array([[0.0, 1.0, 2.0, 5.0], [1e-9, 3.0, 4.0, 6.0]])
    curve = Spectrum((0.0, 0.0), "force", ("Z", "F", "F back", "Other"), ("m", "N", "N", "V"), values, night.now_ns)
    store.take([night.packet(ChannelRoles({}, (), roles)), night.packet(curve, "Spec1d_force")])
    run = afspm.open_run(tmp_path)
    found = run.spectrum(run.spectra[0])
    assert found.of("force, retrace").tolist() == [2.0, 4.0]
    assert found.of("height").tolist() == [0.0, -1e-9]
    assert not found.has("bias")


def test_scan_recorded_without_roles_is_read(night: Night, store: RecordStore, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    store.take(night.whole_scan(1))
    file = tmp_path / afspm.open_run(tmp_path).scans[0].file
    with h5py.File(file, "r+") as opened:  # as versions without roles wrote it
        kept = opened["entry/afspm"]
        about = json.loads(kept["about"][()])
        for channel in about["channels"]:
            del channel["roles"]
        del kept["about"]
        kept["about"] = json.dumps(about)
    assert [scan.roles for scan in read(file).scans] == [(), ()]


def test_file_follows_nexus(night: Night, store: RecordStore, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    store.take(night.whole_scan(1))
    with h5py.File(tmp_path / afspm.open_run(tmp_path).scans[0].file) as file:
        assert file.attrs["NX_class"] == "NXroot"
        entry = file[file.attrs["default"]]
        assert (entry.attrs["NX_class"], entry["definition"].asstr()[()]) == ("NXentry", "NXspm")
        data = entry[entry.attrs["default"]]
        assert data.attrs["NX_class"] == "NXdata"
        signals = [data.attrs["signal"], *data.attrs["auxiliary_signals"]]
        assert [data[name].attrs["long_name"] for name in signals] == ["Height", "Height Retrace"]
        rows, columns = (data[axis] for axis in data.attrs["axes"])
        assert data[signals[0]].shape == (len(rows), len(columns))
        assert {data[name].attrs["units"] for name in (*signals, *data.attrs["axes"])} == {"m"}
        assert [rows[0], rows[-1]] == pytest.approx([-2.25e-6, -1.75e-6])
        region = entry["experiment_instrument/scan_environment/scan_control/scan_region"]
        assert region["scan_offset_value_x"][()] == pytest.approx(REGION.center_m[0])
        assert region["scan_angle_x"][()] == pytest.approx(np.degrees(0.25))
        assert entry["experiment_description"].asstr()[()] == "SIMULATED"


def test_repeated_packets_change_nothing(night: Night, store: RecordStore, tmp_path: Path) -> None:
    given = [night.control(), *night.whole_scan(1), night.state(ScopeState.SPEC), night.spectrum()]
    for _ in range(3):
        store.take(given)
    again = RecordStore(tmp_path, ABOUT)  # in another life
    again.take(given)
    again.close()
    run = afspm.open_run(tmp_path)
    assert (len(run.scans), len(run.spectra)) == (1, 1)
    assert len(list((tmp_path / "scans").iterdir())) == 1
    assert same(list(run.packets()), given)


def test_packets_are_read_back_as_published(night: Night, store: RecordStore, tmp_path: Path) -> None:
    given = [night.control(), night.feedback(), night.state(ScopeState.SCANNING), night.lines(2), night.lines(4, 2)]
    given += [*night.scans(1), night.state(ScopeState.FREE), night.state(ScopeState.SPEC), night.spectrum()]
    # what lines show is part of the scan that comes
    height = wire.decode("Scan2d", given[5][0].payload).values
    for at, rows in ((3, slice(0, 2)), (4, slice(2, 6))):
        lines = wire.decode("ScanLines", given[at][0].payload)
        payload = wire.encode(type(lines)(**{**_fields(lines), "values": height[rows]}))[1]
        given[at] = (Packet("ScanLines", payload, given[at][0].time_ns), given[at][1])
    store.take(given)
    run = afspm.open_run(tmp_path)
    assert same(list(run.packets()), given)
    assert same(list(run.packets(messages=["ControlState"])), given[:1])
    assert same(list(run.packets(since_ns=given[6][0].time_ns or 0)), given[7:])


def test_single_packets_are_read_back_as_published_from_one_reading_of_their_file(
    night: Night, store: RecordStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [night.control(), night.state(ScopeState.SCANNING), night.lines(2), *night.scans(1)]
    given += [night.state(ScopeState.FREE)]
    height = wire.decode("Scan2d", given[3][0].payload).values
    lines = wire.decode("ScanLines", given[2][0].payload)
    given[2] = (replace(given[2][0], payload=wire.encode(replace(lines, values=height[:2]))[1]), given[2][1])
    store.take(given)
    files: list[Path] = []
    monkeypatch.setattr(formats, "read", lambda path: (files.append(path), read(path))[1])
    run = afspm.open_run(tmp_path)
    packet_of = run.packet_lookup()
    for _ in range(2):
        assert same([packet_of(packet.time_ns or 0, packet.envelope) for packet, _ in given], given)
    assert len(files) == 1
    with pytest.raises(FileError, match=r"lacks the packet Scan2d_none of \d+ ns"):
        packet_of(START_NS, "Scan2d_none")


def test_scan_without_values_is_read_back_as_published(night: Night, store: RecordStore, tmp_path: Path) -> None:
    # no file can be made of it; the journal has its settings
    bare = Scan(REGION, "Topo", "m", np.empty((0, 0)), pixels=(6, 8))
    given = [night.state(ScopeState.SCANNING), night.packet(bare, "Scan2d_1000.0_Topo"), *night.scans(1)]
    given.append(night.state(ScopeState.FREE))
    store.take(given)
    run = afspm.open_run(tmp_path)
    assert same(list(run.packets()), given)
    assert [row.channels for row in run.scans] == [(("Height", "m"), ("Height Retrace", "m"))]
    assert next(wire.decode("Scan2d", p.payload) for p in run.packets(messages=["Scan2d"])).shape == (6, 8)


def test_lines_of_a_channel_published_after_the_end_are_kept(night: Night, store: RecordStore, tmp_path: Path) -> None:
    given = [night.state(ScopeState.SCANNING), night.lines(2), night.scans(1)[1]]
    store.take(given)
    store.finish()
    run = afspm.open_run(tmp_path)
    assert [row.channels for row in run.scans] == [(("Height Retrace", "m"),)]
    assert same(list(run.packets()), given)


def _fields(lines: Any) -> dict[str, Any]:
    return {name: getattr(lines, name) for name in ("region", "shape", "channel", "unit", "first_row", "began_ns")}


def test_channels_in_files_of_their_own_are_one_scan(night: Night, store: RecordStore, tmp_path: Path) -> None:
    given = [night.scan_in_files(number) for number in (1, 2)]
    store.take([*given[0], *given[1], night.state(ScopeState.FREE)])
    run = afspm.open_run(tmp_path)
    assert [row.filename for row in run.scans] == ["s1-Topo.nc", "s2-Topo.nc"]
    assert list(run.scan(0)) == ["Topo", "Current", "Phase"]
    assert same(list(run.packets()), [*given[0], *given[1], (list(run.packets())[-1], "")])


def test_channels_in_files_of_their_own_find_their_scan_after_a_kill(night: Night, tmp_path: Path) -> None:
    given = night.scan_in_files(1)
    store = RecordStore(tmp_path, ABOUT)
    store.take(given[:1])
    store.flush()
    store.close()
    again = RecordStore(tmp_path, ABOUT)
    again.take(given[1:])
    again.take([night.state(ScopeState.FREE)])
    again.close()
    run = afspm.open_run(tmp_path)
    assert len(run.scans) == 1
    assert list(run.scan(0)) == ["Topo", "Current", "Phase"]


def test_scans_of_one_time_in_several_files_are_not_mixed(night: Night, store: RecordStore, tmp_path: Path) -> None:
    # a controller whose clock has seconds may take two scans in one
    scans = [*night.scans(1, ("Height",), START_NS), *night.scans(2, ("Height",), START_NS)]
    store.take([*scans, night.state(ScopeState.FREE)])
    run = afspm.open_run(tmp_path)
    assert [row.filename for row in run.scans] == ["scan-0001.nc", "scan-0002.nc"]


def test_packets_of_unknown_messages_are_kept_as_they_are(store: RecordStore, tmp_path: Path) -> None:
    strange = (Packet("Peaks_of_mine", b"\x01\x02", START_NS), "")
    store.take([strange])
    assert same(list(afspm.open_run(tmp_path).packets()), [strange])


def test_channel_that_comes_after_a_kill_joins_the_others(night: Night, tmp_path: Path) -> None:
    scanning, first, second, free = night.whole_scan(1)
    store = RecordStore(tmp_path, ABOUT)
    store.take([scanning, first])
    store.flush()
    store.close()
    again = RecordStore(tmp_path, ABOUT)
    again.take([scanning, first, second, free])
    again.close()
    run = afspm.open_run(tmp_path)
    assert list(run.scan(0)) == ["Height", "Height Retrace"]
    assert [name for name, _ in run.scans[0].channels] == ["Height", "Height Retrace"]
    assert len(list((tmp_path / "scans").iterdir())) == 1
    assert same(list(run.packets()), [scanning, first, second, free])


def test_interrupted_scan_keeps_its_received_lines(night: Night, store: RecordStore, tmp_path: Path) -> None:
    given = [night.control(), night.state(ScopeState.FREE), night.state(ScopeState.SCANNING)]
    given += [night.lines(2, 0), night.lines(1, 2), night.state(ScopeState.INTERRUPTED), night.state(ScopeState.FREE)]
    store.take(given)
    run = afspm.open_run(tmp_path)
    (row,) = run.scans
    assert (row.interrupted, row.holder, row.began_ns) == (True, "series", given[2][0].time_ns)
    values = run.scan(row)["Height"].values
    assert np.isfinite(values[:3]).all()
    assert np.isnan(values[3:]).all()
    assert same(list(run.packets()), given)


def test_interrupted_scan_without_lines_has_a_row(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take([night.state(ScopeState.SCANNING), night.state(ScopeState.INTERRUPTED), night.state(ScopeState.FREE)])
    run = afspm.open_run(tmp_path)
    (row,) = run.scans
    assert (row.interrupted, row.file, row.region, row.channels) == (True, "", None, ())
    with pytest.raises(FileError, match="interrupted before anything"):
        run.scan(0)


def test_scan_without_an_end_is_kept_when_the_next_begins(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take([night.state(ScopeState.SCANNING), night.lines(), night.state(ScopeState.UNDEFINED)])
    store.take(night.whole_scan(2))
    assert [row.interrupted for row in afspm.open_run(tmp_path).scans] == [True, False]


def test_incomplete_scan_is_not_recorded_yet(night: Night, store: RecordStore) -> None:
    scanning, first, _, _ = night.whole_scan(1)
    store.take([scanning, first])
    assert store.waiting() == [first[0]]
    store.flush()
    assert store.waiting() == []


def test_full_disk_leaves_no_partial_record_and_a_retry_succeeds(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    given = [night.control(), *night.whole_scan(1)]
    with file_limit(1000), pytest.raises(OSError, match="File too large"):
        store.take(given)
    run = afspm.open_run(tmp_path)
    assert (len(run.scans), list(run.packets()), list((tmp_path / "scans").iterdir())) == (0, [], [])
    store.take(given)
    assert same(list(run.packets()), given)
    assert len(run.scan(0)) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="what a descriptor is open on is found in /proc")
def test_journal_on_the_disk_names_no_file_that_is_not(
    night: Night, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """faults 17: the power may be cut after each sync, also of the first scan, whose folder is new."""
    (folder := tmp_path / "night").mkdir()
    disk, named = lossy_disk(folder, monkeypatch), list[int]()
    real = os.fsync

    def cut(descriptor: int) -> None:
        real(descriptor)
        after = tmp_path / f"after-{len(named)}"
        disk.copy(after)
        with suppress(FileError), afspm.open_run(after) as run:  # it has no journal yet
            assert all((after / row.file).is_file() for row in (*run.scans, *run.spectra))
            named.append(len(run.scans))

    store = RecordStore(folder, ABOUT)
    store.sync()
    monkeypatch.setattr(os, "fsync", cut)
    for number in (1, 2):
        store.take([*night.whole_scan(number), night.spectrum(number)])
        store.sync()
    store.close()
    assert named[-1] == 2


def test_file_written_right_before_a_kill_is_not_duplicated(night: Night, tmp_path: Path) -> None:
    given = night.whole_scan(1)
    store = RecordStore(tmp_path, ABOUT)
    store.take([night.state(ScopeState.SCANNING), night.state(ScopeState.INTERRUPTED)])  # it gets number 1
    store.close()
    stamp = "20260314T200000_001000Z"
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / f"{stamp}-00001.h5").write_bytes(b"of a transaction that was not committed")
    (tmp_path / "scans" / f"{stamp}-00002.h5.part").write_bytes(b"half")
    again = RecordStore(tmp_path, ABOUT)
    again.take(given)
    again.close()
    assert [file.name for file in (tmp_path / "scans").iterdir()] == [f"{stamp}-00002.h5"]
    assert afspm.open_run(tmp_path).scans[-1].file == f"scans/{stamp}-00002.h5"


def test_sample_coordinates_are_named(night: Night, tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings({"frame": "sample"}, ProblemNames(), Frame.SAMPLE))
    store.take([*night.whole_scan(1), night.spectrum()])
    store.close()
    run = afspm.open_run(tmp_path)
    assert run.scans[0].region is not None
    assert run.scans[0].region.frame is Frame.SAMPLE
    assert run.scan(0)["Height"].region.frame is run.spectrum(0).frame is Frame.SAMPLE


def test_scans_before_correction_begins_are_in_tip_coordinates(night: Night, tmp_path: Path) -> None:
    about = RecordSettings({"frame": "sample"}, ProblemNames(), Frame.SAMPLE)
    for number, correcting in enumerate((False, None, True)):
        store = RecordStore(tmp_path, about)  # as after a restart
        if correcting is not None:
            store.take([night.packet(wire.message_type("DriftMapping")(correcting=correcting))])
        store.take([*night.whole_scan(number + 1), night.spectrum()])
        store.close()
    run = afspm.open_run(tmp_path)
    frames = [Frame.TIP, Frame.TIP, Frame.SAMPLE]
    assert [row.region.frame for row in run.scans if row.region is not None] == frames
    assert [run.scan(number)["Height"].region.frame for number in range(3)] == frames
    assert [run.spectrum(number).frame for number in range(3)] == frames


def test_without_scans_there_is_the_journal_alone(night: Night, tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings(measured=False))
    store.take([night.control(), *night.whole_scan(1)])
    store.close()
    run = afspm.open_run(tmp_path)
    assert (len(run.scans), len(run.control), (tmp_path / "scans").exists()) == (0, 1, False)
    assert len(list(run.packets())) == 5


def test_controllers_header_is_recorded_if_its_file_is_readable(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    head = b"Gwyddion Simple Field 1.0\nXRes = 2\nYRes = 2\nXReal = 1e-6\nYReal = 1e-6\nTitle = Mine\n"
    (tmp_path / "scan-0001.gsf").write_bytes(head + bytes(4 - len(head) % 4) + bytes(4 * 4))
    scanning, *channels, free = night.whole_scan(1)
    store.take([scanning, *((_named(packet), source) for packet, source in channels), free])
    run = afspm.open_run(tmp_path)
    expected = read(tmp_path / "scan-0001.gsf").header
    assert expected
    assert {name: run.about(run.scans[0])[name] for name in expected} == dict(expected)


@pytest.mark.parametrize("filename", ["no-such-disk/" + 300 * "x", 5000 * "x", "a\0b"])
def test_unreachable_controllers_file_costs_its_header_only(
    night: Night, store: RecordStore, tmp_path: Path, filename: str
) -> None:
    scanning, *channels, free = night.whole_scan(1)
    store.take([scanning, *((_with(packet, filename=filename), source) for packet, source in channels), free])
    assert len(afspm.open_run(tmp_path).scan(0)) == 2


def test_measurement_without_a_file_is_kept_in_the_journal_and_others_are_recorded(
    night: Night, store: RecordStore, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scanning, *channels, free = night.whole_scan(1)
    wrong = [(_with(packet, unit="m\0"), source) for packet, source in channels]  # HDF5 has no such texts
    given = [scanning, *wrong, free, *night.whole_scan(2)]
    store.take(given)
    run = afspm.open_run(tmp_path)
    assert same(list(run.packets()), given)
    assert len(run.scans) == 1
    assert len(run.scan(0)) == 2
    assert "no file can be made of what was measured" in caplog.text
    assert store.waiting() == []


def _named(packet: Packet) -> Packet:
    return _with(packet, filename="scan-0001.gsf")


def _with(packet: Packet, **changes: Any) -> Packet:
    from dataclasses import replace

    scan = wire.decode("Scan2d", packet.payload)
    return Packet(packet.envelope, wire.encode(replace(scan, **changes))[1], packet.time_ns)


def test_requests_processes_and_log_lines_have_their_tables(night: Night, store: RecordStore, tmp_path: Path) -> None:
    entries = (
        JournalEntry(1, "request", "series", "start-scan", 0, "", 0.01),
        JournalEntry(2, "request", "dashboard:Ada", "start-scan", 6, "the series is in control", 0.02),
    )
    alive, again = (
        ProcessState("series", "component", condition, since, 0.5, starts, 4711, exit_)
        for condition, since, starts, exit_ in (
            (ProcessCondition.ALIVE, 5, 1, ""),
            (ProcessCondition.ALIVE, 9, 2, "killed by SIGKILL"),
        )
    )
    states = [
        night.packet(ProcessStates(time, "lab", (state,))) for time, state in ((5, alive), (7, alive), (9, again))
    ]
    log = night.packet(LogLines((LogLine(3, "series", "INFO", "scan 1 of 3"),)))
    store.take([night.packet(JournalEntries(entries)), *states, log])
    run = afspm.open_run(tmp_path)
    assert tuple(run.journal) == entries
    assert tuple(run.refusals) == entries[1:]
    assert [row.starts for row in run.processes] == [1, 2]
    assert [(row.name, row.starts, row.last_exit) for row in run.restarts] == [("series", 2, "killed by SIGKILL")]
    assert [line.text for line in run.log] == ["scan 1 of 3"]


def test_process_change_is_found_without_a_search_of_the_whole_night(store: RecordStore, tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / JOURNAL_FILE)) as journal:
        ((*_, plan),) = journal.execute(f"EXPLAIN QUERY PLAN {_PROCESS}", ("series",)).fetchall()
    assert "processes_by_name" in plan


def test_packets_taken_together_are_one_transaction_and_readers_never_wait(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    run = afspm.open_run(tmp_path)

    def packets() -> Iterator[tuple[Packet, str]]:
        yield night.control()
        assert len(run.control) == 0
        yield night.state(ScopeState.FREE)

    store.take(packets())
    assert len(run.control) == 1


def test_journal_is_synced_before_its_write_ahead_log_is_restarted(store: RecordStore) -> None:
    # SQLite syncs by itself; its pragma reports whether it does: 0 is never
    assert store._journal.execute("PRAGMA synchronous").fetchone()[0] >= 1


def readings(night: Night, kelvin: float | None) -> Given:
    reading = InstrumentReading("cryo.temperature", kelvin, "K", 0.25, 4.2, reason="" if kelvin else "no sensor")
    return night.packet(InstrumentReadings(night.now_ns, "cryo", (reading,)), "InstrumentReadings_cryo")


def test_scan_has_the_readings_of_its_time(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take([night.control(), *night.whole_scan(1)])
    store.take([readings(night, 4.4), night.state(ScopeState.SCANNING), readings(night, 4.1), readings(night, 4.3)])
    store.take([*night.scans(2), night.state(ScopeState.FREE)])
    night.now_ns += 61 * 10**9
    store.take([*night.whole_scan(3)])
    store.flush()
    run = afspm.open_run(tmp_path)
    found = [(number, one) for number, scan in enumerate(run.scans) for one in run.about(scan).get("instruments", ())]
    ((number, reading),) = found
    assert number == 1
    assert (reading["value"], reading["lowest"], reading["highest"]) == (4.3, 4.1, 4.3)
    assert 0.25 < reading["age_s"] < 0.3


def test_rows_have_the_values_of_instruments_and_name_the_condition_that_did_not_hold(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    bands = '"cryo.temperature" = { from = "4 K", to = "4250 mK" }\n[conditions.settled]\n'
    bands += '"cryo.temperature" = { within = "0.3 K" }\nwhile = ["start-spec"]\n'
    (tmp_path / EXPERIMENT_FILE).write_text(f"[conditions.cold]\n{bands}", encoding="utf-8")
    store.take([night.control(), *night.whole_scan(1)])
    store.take([readings(night, 4.4), night.state(ScopeState.SCANNING), readings(night, 4.1), readings(night, 4.2)])
    store.take([*night.scans(2), night.state(ScopeState.FREE)])
    store.take([night.state(ScopeState.SCANNING), readings(night, 4.3), readings(night, 4.2), *night.scans(3)])
    store.take([night.state(ScopeState.FREE), night.state(ScopeState.SCANNING), readings(night, None)])
    store.take([*night.scans(4), night.state(ScopeState.FREE)])
    store.take([readings(night, 4.6), night.state(ScopeState.SPEC), night.spectrum()])
    store.flush()
    run = afspm.open_run(tmp_path)
    columns = run.scans.columns()
    assert columns["cryo.temperature [K]"] == [None, 4.2, 4.2, None]
    assert columns["outside"] == ["", "", "cold", "cold"]
    assert [one is not None and 0.25 < one < 0.3 for one in columns["cryo.temperature.age [s]"]] == [False, *[True] * 3]
    assert [(one.lowest, one.highest) for one in run.scans[2].instruments] == [(4.2, 4.3)]
    assert run.spectra[0].outside == ("cold", "settled")
    assert [scan.outside for scan in run.overview().scans if scan.channel == "Height"] == [(), (), ("cold",), ("cold",)]
    page = report.write(tmp_path).read_text(encoding="utf-8")
    assert "outside: cold" in page
    assert "4.1 K to 4.6 K" in page
    store.take([readings(night, 4.2), *night.whole_scan(5)])
    store.flush()
    assert run.scans[-1].instruments[0].value == 4.2, "the table is read on while the run grows"


def test_readings_are_as_old_as_real_time_says(night: Night, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"clock": {"speed": 60.0}}', encoding="utf-8")
    with closing(RecordStore(tmp_path, RecordSettings(speed=60.0))) as store:
        store.take([night.control(), readings(night, 4.2)])
        night.now_ns += 600 * 10**9  # ten seconds
        store.take(night.whole_scan(1))
        store.flush()
    run = afspm.open_run(tmp_path)
    (row,) = run.scans
    (found,) = row.instruments
    assert found.value == 4.2
    assert found.age_s == pytest.approx(10.25, abs=0.1)
    assert run.about(row)["instruments"][0]["age_s"] == pytest.approx(found.age_s)


def test_spectrum_that_a_component_publishes_again_after_a_kill_is_recorded_once(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    once, _ = night.spectrum()
    again = replace(once, time_ns=(once.time_ns or 0) + 1_000_000)
    store.take([(once, "esr"), (again, "esr")])
    store.take([(replace(again, time_ns=(again.time_ns or 0) + 1), "esr")])
    assert len(afspm.open_run(tmp_path).spectra) == 1


def test_other_spectrum_of_the_same_time_is_kept_and_named(
    night: Night, store: RecordStore, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    here = Spectrum((0.0, 0.0), "rf", ("rf", "x"), ("Hz", "V"), np.zeros((3, 2)), START_NS)
    store.take([(night.packet(here)[0], "esr"), (night.packet(replace(here, position_m=(1e-9, 0.0)))[0], "esr")])
    assert len(afspm.open_run(tmp_path).spectra) == 1
    assert "another spectrum 'rf' has the same time: number 1" in caplog.text
