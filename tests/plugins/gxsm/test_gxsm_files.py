"""Files of the emulated GXSM: when they appear, how they are named, and what is read from them."""

from __future__ import annotations

import logging
import os
import re
import time
from pathlib import Path

import numpy as np
import pytest

from afspm import read
from afspm.basics import FileError, convert
from afspm.emulation import ControllerClock, Faults
from afspm.plugins.gxsm import result_files
from afspm.plugins.gxsm.emulator import files
from afspm.plugins.gxsm.emulator.file_writer import FAULT_KINDS, GxsmFileWriter
from afspm.plugins.gxsm.emulator.files import CHANNELS
from afspm.plugins.gxsm.scan_files import stored_unit

START_S = 1000.0


def sizes(folder: Path) -> dict[str, int]:
    return {file.name: file.stat().st_size for file in folder.iterdir()}


def test_files_appear_after_the_end_one_by_one_the_last_first_and_in_parts(tmp_path: Path) -> None:
    saving = GxsmFileWriter(tmp_path, Faults([], FAULT_KINDS, START_S), ControllerClock())
    saving.write([(tmp_path / "a", bytes(100)), (tmp_path / "b", bytes(200))], START_S)
    seen = [sizes(tmp_path)]
    next_s: float | None = START_S
    while next_s is not None:
        next_s = saving.advance(next_s)
        if sizes(tmp_path) != seen[-1]:
            seen.append(sizes(tmp_path))
    assert seen == [{}, {"b": 100}, {"b": 200}, {"b": 200, "a": 50}, {"b": 200, "a": 100}]


def test_next_number_is_the_first_free_one(tmp_path: Path) -> None:
    saving = GxsmFileWriter(tmp_path, Faults([], FAULT_KINDS, START_S), ControllerClock())
    (tmp_path / "scan001-Xp-a.nc").touch()
    number = saving.next_number()
    paths = [saving.free(ending, number) for ending in ("Xp-a.nc", "Xp-b.nc")]
    assert [path.name for path in paths] == ["scan002-Xp-a.nc", "scan001-Xp-b.nc"]
    saving.counted(paths)
    assert saving.named("Xp-a.nc", saving.counter).name == "scan003-Xp-a.nc"


@pytest.mark.parametrize(
    ("label", "name", "channel"),
    [
        ("I", "Xp-ADC0mITunnel", "ADC0-ITunnel"),
        ("I", "Xm-ADC0mITunnel", "ADC0-ITunnel Backward"),
        ("Z", "M-Xp-Topo", "Topo"),
        ("Hz", "Xp-dFreq", "dFreq"),
        ("U", "Xp-AmplPLL", "AmplPLL"),
    ],
)
def test_the_dash_in_the_name_of_a_channel_is_restored(tmp_path: Path, label: str, name: str, channel: str) -> None:
    # Gxsm3 has a channel's name only in the file's name, with an "m" for each dash.
    path = tmp_path / f"scan001-{name}.nc"
    image, frame = np.ones((3, 4), np.float32), (0.0, 0.0, 100.0, 100.0, 0.0)
    saved = files.GxsmScanFile(
        str(path), label, image, 1.0, ("nA", "nA"), frame, START_S, START_S + 9, "SPM-SIM:SPM", 1.0
    )
    path.write_bytes(files.netcdf3(saved))
    assert [scan.channel for scan in read(path).scans] == [channel]


def saved_scan(path: Path, version: int, *, unit: str = "nA", label: str = "I-Tunnel", original: str = "") -> Path:
    """Write a scan of the stored value 166.592."""
    frame = (0.0, 0.0, 100.0, 100.0, 0.0)
    named = unit, files.UNITS[unit][0]
    scan = files.GxsmScanFile(
        str(path),
        label,
        np.full((3, 4), 83.296, np.float32),
        2.0,
        named,
        frame,
        START_S,
        START_S + 9,
        "SPM-SIM:SPM",
        1.0,
        original,
    )
    path.write_bytes(files.netcdf3(scan) if version == 3 else files.netcdf4(scan))
    return path


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(
    ("shown", "unit", "value"),
    [
        *((name, "m", 166.592e-10) for name in ("AA", "nm", "um", "mm")),
        *((name, "V", 166.592) for name in ("V", "mV")),
        ("mV1", "mV", 166.592),
        *((name, "nA", 166.592) for name in ("nA", "pA", "Amp")),
        *((name, "Hz", 166.592) for name in ("Hz", "mHz")),
        ("deg", "°", 166.592),
    ],
)
def test_values_are_in_gxsms_base_unit_in_spite_of_the_display_unit(
    tmp_path: Path, version: int, shown: str, unit: str, value: float
) -> None:
    path = saved_scan(tmp_path / "scan001-Xp-ImTunnel.nc", version, unit=shown)
    (scan,) = read(path).scans
    assert scan.unit == unit
    np.testing.assert_allclose(scan.values, value, rtol=1e-6)
    if version == 4:  # GXSM's own sentence about the first value, in its display unit
        described = re.search(r"is (\S+) (\S+)\.$", _attribute(path, "Info"))
        assert described
        in_our_unit = float(described[1]) if described[2] == unit else convert(float(described[1]), described[2], unit)
        assert in_our_unit == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize(
    ("symbol", "unit"), [("nm", "Å"), ("µm", "Å"), ("mV", "V"), ("pA", "nA"), ("A", "nA"), ("mHz", "Hz"), ("K", "K")]
)
def test_a_symbol_alone_names_the_display_unit(symbol: str, unit: str) -> None:
    assert stored_unit("", symbol) == unit


def _attribute(path: Path, name: str) -> str:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path) as file:
        return str(file["FloatField"].attrs[name].decode())


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(
    ("name", "channel"),
    [("scan004-M-Xp-ZSmTopo", "ZS-Topo"), ("scan004-Xm-ZSmTopo", "ZS-Topo Backward"), ("renamed", "ZS-Topo")],
)
def test_a_file_that_was_opened_before_does_not_name_a_channel(
    tmp_path: Path, version: int, name: str, channel: str
) -> None:
    path = saved_scan(tmp_path / f"{name}.nc", version, label="ZS-Topo", original="/data/old001-Xm-ImTunnel.nc")
    assert [scan.channel for scan in read(path).scans] == [channel]


@pytest.mark.parametrize(("label", "part", "channel"), [("ZS-Topo", "ZSmTopo", "ZS-Topo"), ("Z", "Topo", "Topo")])
def test_a_renamed_file_has_the_direction_of_its_first_name(
    tmp_path: Path, label: str, part: str, channel: str
) -> None:
    path = saved_scan(tmp_path / "best.nc", 3, label=label, original=f"/data/scan007-Xm-{part}.nc")
    assert [scan.channel for scan in read(path).scans] == [f"{channel} Backward"]


@pytest.mark.parametrize(
    ("label", "unit"),
    [
        ("08-LockIn-Mag (mV)", "V"),
        ("McBSP Ampl (mV)", "V"),
        ("In 0 (pA)", "nA"),
        ("ADC0-I (pA)", "pA"),
        ("Amplitude (mV)", "mV"),
    ],
)
def test_a_column_of_a_spectrum_has_the_unit_of_its_values(tmp_path: Path, label: str, unit: str) -> None:
    columns = {"Bias (V)": np.linspace(-1.0, 1.0, 5), label: np.arange(5.0)}
    path = tmp_path / "scan001-VP001-VP.vpdata"
    path.write_bytes(files.vpdata(files.GxsmSpectrumFile(str(path), columns, START_S, (0.0, 0.0), 0.1, "00.03")))
    (curve,) = read(path).spectra
    assert curve.units == ("V", unit)
    np.testing.assert_array_equal(curve.values[:, 1], np.arange(5.0))


SHAPE = (4, 6)
FRAME = (3000.0, -2000.0, 500.0, 300.0, -10.0)
"""Offset and range in Å, and the angle, clockwise."""
SCANNED = [(version, channel) for version in (3, 4) for channel in CHANNELS[version] if channel.direction == "Xp"]


@pytest.mark.parametrize(("version", "channel"), SCANNED, ids=lambda one: getattr(one, "label", one))
def test_a_scan_written_by_the_emulator_is_read_as_it_was_measured(
    tmp_path: Path, version: int, channel: files.GxsmChannel
) -> None:
    values = (
        np.arange(1.0, SHAPE[0] * SHAPE[1] + 1).reshape(SHAPE) / channel.scale
    )  # from 1 to 24 in the channel's unit
    path = tmp_path / f"scan002-{channel.ending(master=False)}"
    saved = files.GxsmScanFile(
        str(path), channel.label, channel.raw(values), channel.dz, channel.unit, FRAME, START_S, START_S + 9, "SPM", 2.0
    )
    path.write_bytes(files.netcdf3(saved) if version == 3 else files.netcdf4(saved))
    content = read(path)
    (scan,) = content.scans
    to_si = 1e-10 if scan.unit == "m" else 1.0
    np.testing.assert_allclose(scan.values, values * channel.scale * to_si, rtol=1e-6)
    assert scan.channel == channel.label
    np.testing.assert_allclose(scan.region.center_m, (300e-9, -200e-9))
    np.testing.assert_allclose(scan.region.size_m, (50e-9, 30e-9))
    assert (content.start_ns, content.end_ns) == (int(START_S * 1e9), int((START_S + 9) * 1e9))


def test_a_spectrum_written_by_the_emulator_is_read_as_it_was_measured(tmp_path: Path) -> None:
    columns = {"Bias (V)": np.array([-1.0, 0.0, 1.0]), "Z-mon (Å)": np.array([10.0, 20.0, 30.0])}
    path = tmp_path / "scan006-VP001-VP.vpdata"
    path.write_bytes(files.vpdata(files.GxsmSpectrumFile("x", columns, START_S, (0.0, 0.0), 0.25, "00.02")))
    content = read(path)
    (curve,) = content.spectra
    assert (curve.kind, curve.names, curve.units) == ("VP", ("Bias", "Z-mon"), ("V", "m"))
    np.testing.assert_allclose(curve.values, [[-1.0, 1e-9], [0.0, 2e-9], [1.0, 3e-9]])
    assert content.end_ns == int(START_S * 1e9)


def test_files_of_earlier_nights_are_not_read_in_a_folder_that_gxsm_names_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # 330 of them took 27 s, in which the translator answered nothing
    for number in range(5):
        old = tmp_path / f"night{number:03}-M-Xp-Topo.nc"
        old.write_bytes(b"CDF")
        os.utime(old, (1e9, 1e9))
    own = tmp_path / "run001-M-Xp-Topo.nc"
    own.write_bytes(b"CDF")
    asked: list[Path] = []

    def read(file: Path) -> None:
        asked.append(file)
        raise FileError("half")

    monkeypatch.setattr(result_files, "read_result", read)
    saved, now_ns = (
        result_files.GxsmFiles({}, logging.getLogger(), patience_s=10.0, soon_s=1.0, late_s=20.0),
        time.time_ns(),
    )
    taken = {"frame": [0.0, 0.0, 1e-6, 1e-6, 0.0], "shape": [8, 8], "place": [0.0, 0.0, 0.0]}
    saved.begin("scan", None, now_ns - 5 * 10**9, taken)
    saved.end(now_ns, now_ns, [str(own)], tmp_path)
    for _ in range(2):  # a file is read once it has not grown between two looks
        saved.results(now_ns / 1e9)
    assert asked == [own]
