"""A run with missing and damaged files: each costs its own values alone, and is named, wherever the run is read."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from record_lab import ABOUT, Night

import afspm
from afspm.basics import entry_points
from afspm.basics.errors import FileError
from afspm.model import ScopeState, Spectrum
from afspm.night.catalogue import find_runs
from afspm.night.run import Run
from afspm.plugins.bluesky import documents
from afspm.plugins.drift.frame import remount
from afspm.plugins.replay.replay import ReplayOptions, replay
from afspm.plugins.web.archive import Archive
from afspm.plugins.web.dashboard.night import Night as NightOfPage
from afspm.record.store import RecordStore
from afspm.report import night_report as report
from afspm.report.catalogue_page import write_page
from afspm.report.export import export

SCANS, SPECTRA = 5, 9
MISSING, DAMAGED = 1, 2  # indices among scans and spectra


@dataclass
class Lab:
    """A run of scans at one place, one of them with lines, and a grid of spectra; four files are lost."""

    run: Run
    lost: list[str]

    @property
    def folder(self) -> Path:
        return self.run.folder

    def is_named(self, texts: list[str]) -> bool:
        return all(any(Path(file).name in text for text in texts) for file in self.lost)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "night-1"
    folder.mkdir()
    (folder / "run.json").write_text("{}", encoding="utf-8")
    store, night = RecordStore(folder, ABOUT), Night()
    store.take([night.control()])
    for number in range(1, SCANS + 1):
        lines = [night.lines(), night.lines(first=2)]
        store.take([night.state(ScopeState.SCANNING), *lines, *night.scans(number), night.state(ScopeState.FREE)])
    for number in range(SPECTRA):
        place = ((number % 3) * 1e-7, (number // 3) * 1e-7)
        curve = np.stack([np.linspace(-1, 1, 20), night.random.normal(size=20)], axis=1)
        spectrum = Spectrum(place, "IV", ("Bias", "Current"), ("V", "A"), curve, night.now_ns, f"s{number}")
        store.take([night.state(ScopeState.SPEC), night.packet(spectrum, "Spec1d_IV"), night.state(ScopeState.FREE)])
    store.finish()
    store.close()
    return folder


@pytest.fixture
def lab(recorded: Path, tmp_path: Path) -> Lab:
    folder = tmp_path / "runs" / recorded.name
    shutil.copytree(recorded, folder)
    run = afspm.open_run(folder)
    lost = [table[which].file for table in (run.scans, run.spectra) for which in (MISSING, DAMAGED)]
    for number, file in enumerate(lost):
        if number % 2:
            with (folder / file).open("r+b") as opened:
                opened.truncate(1000)
        else:
            (folder / file).unlink()
    return Lab(run, lost)


# faults 17


def test_packets_of_lost_files_alone_are_left_out(lab: Lab, recorded: Path, caplog: pytest.LogCaptureFixture) -> None:
    whole = list(afspm.open_run(recorded).packets())
    found = list(lab.run.packets())
    assert len(whole) - len(found) == 2 * (2 + 2) + 2  # two channels and two packets of lines; a spectrum
    assert {(one.time_ns, bytes(one.payload)) for one in found} < {(one.time_ns, bytes(one.payload)) for one in whole}
    assert lab.is_named(caplog.messages)
    assert len(caplog.messages) == len(lab.lost)
    lookup = lab.run.packet_lookup()
    for packet in whole:
        key = packet.time_ns or 0, packet.envelope
        if packet in found:
            assert lookup(*key) == packet
        else:
            with pytest.raises(FileError, match="|".join(Path(file).name for file in lab.lost)):
                lookup(*key)


def test_rows_events_and_other_values_are_there(lab: Lab, caplog: pytest.LogCaptureFixture) -> None:
    run = lab.run
    assert (len(run.scans), len(run.spectra)) == (SCANS, SPECTRA)
    assert sum(message == "Scan2d" for _, message, _ in run.messages()) == 2 * SCANS
    assert len(run.overview().scans) == 2 * SCANS
    for which in (MISSING, DAMAGED):
        for read in (run.scan, run.spectrum):
            with pytest.raises(FileError):
                read(which)
    assert len(run.scan(0)) == 2
    assert not caplog.messages
    stack = run.spectra.stack(interpolate=True)
    assert stack.sizes["x"] * stack.sizes["y"] == SPECTRA
    assert int(np.isfinite(run.spectra.map("Current", at=0.0).values).sum()) == SPECTRA - 2
    film = run.film()
    assert film.numbers == (1, 4, 5)
    assert lab.is_named(caplog.messages)


def test_report_names_them(lab: Lab) -> None:
    text = report.write(lab.folder).read_text(encoding="utf-8")
    assert lab.is_named([text])
    assert text.count("no values") == 2


@pytest.mark.parametrize("to", entry_points.names(entry_points.EXPORTERS))
def test_export_writes_all_others_and_names_them(
    lab: Lab, to: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    if to == "mp4":
        pytest.importorskip("av")
    if to in ("png", "pdf"):
        pytest.importorskip("matplotlib")
    told: list[str] = []
    few = "1-3" if to in ("png", "pdf") else None  # each figure takes a tenth of a second
    assert list(export(lab.run, to, tmp_path / "out", few, told.append))
    named = [*told, *caplog.messages]
    of_scans, of_spectra = lab.lost[:2], lab.lost[2:]
    wanted = {"csv": of_spectra, "excel": of_spectra, "eln": lab.lost[::2]} | dict.fromkeys(
        ("gif", "mp4", "png", "pdf"), of_scans
    )
    assert replace(lab, lost=wanted.get(to, lab.lost)).is_named(named)


def test_replay_publishes_all_others_and_names_them(lab: Lab, tmp_path: Path) -> None:
    told: list[str] = []
    options = ReplayOptions(speed=1e6, only=["Scan2d", "Spec1d"], runs=tmp_path / "again")
    assert replay(lab.folder, options, told.append) == 2 * (SCANS - 2) + SPECTRA - 2
    assert lab.is_named(told)


def test_page_shows_all_others_and_names_them_once(lab: Lab, caplog: pytest.LogCaptureFixture) -> None:
    night, archive = NightOfPage(lab.folder), Archive(lab.folder)
    assert len(night.scans) == SCANS
    for _ in range(2):
        assert sum(archive.frame(row.time_ns, "Height") is not None for row in night.scans) == SCANS - 2
        assert sum(archive.spectrum(row.time_ns) is not None for row in lab.run.spectra) == SPECTRA - 2
    assert lab.is_named(caplog.messages)
    assert len(caplog.messages) == len(lab.lost)


def test_catalogue_and_remount_go_on(lab: Lab, caplog: pytest.LogCaptureFixture) -> None:
    root = lab.folder.parent
    (found,) = find_runs(root)
    assert (found.scans, found.spectra, found.damage) == (SCANS, SPECTRA, "")
    assert write_page(root, [found]).read_text(encoding="utf-8").count("<img") == SCANS - 2
    lost = lab.run.scans[0].file
    (lab.folder / lost).unlink()
    row, _ = remount.overview_of(lab.run)
    assert row.number == 4
    assert Path(lost).name in "".join(caplog.messages)


def test_documents_point_to_all_of_them(lab: Lab) -> None:
    found = documents.documents(lab.run, lab.run.scans, lab.run.spectra)
    assert sum(name == "event" for name, _ in found) == SCANS + SPECTRA
