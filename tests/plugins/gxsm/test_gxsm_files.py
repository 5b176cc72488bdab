"""Files of the emulated GXSM, compared with real ones: same content, read the same way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm.plugins.gxsm.emulator import files
from afspm.plugins.gxsm.emulator.file_writer import FAULT_KINDS, GxsmFileWriter
from afspm.plugins.gxsm.emulator.files import CHANNELS
from afspm.simulation.faults import Faults
from afspm.storage.formats import netcdf, read

DATA = Path(__file__).parents[4] / "shared" / "data" / "gxsm"
REAL = {
    3: {"Topo": "gxsm3/scan002-M-Xp-Topo.nc", "ADC1": "gxsm3/scan002-Xp-ADC1.nc"},
    4: {
        "ZS-Topo": "gxsm4/scan002-M-Xp-ZSmTopo.nc",
        "I-Tunnel": "gxsm4/scan002-Xp-ImTunnel.nc",
        "dFreq": "gxsm4/scan002-Xp-dFreq.nc",
    },
}
CURVE = "gxsm4/scan006-VP001-VP.vpdata"
BOTH = [(version, label) for version, files_ in REAL.items() for label in files_]

START_S = 1000.0

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the real files are not here")


def sizes(folder: Path) -> dict[str, int]:
    return {file.name: file.stat().st_size for file in folder.iterdir()}


def test_files_appear_after_the_end_one_by_one_the_last_first_and_in_parts(tmp_path: Path) -> None:
    saving = GxsmFileWriter(tmp_path, Faults([], FAULT_KINDS, START_S))
    saving.write([(tmp_path / "a", bytes(100)), (tmp_path / "b", bytes(200))], START_S)
    seen = [sizes(tmp_path)]
    next_s: float | None = START_S
    while next_s is not None:
        next_s = saving.advance(next_s)
        if sizes(tmp_path) != seen[-1]:
            seen.append(sizes(tmp_path))
    assert seen == [{}, {"b": 100}, {"b": 200}, {"b": 200, "a": 50}, {"b": 200, "a": 100}]


def test_next_number_is_the_first_free_one(tmp_path: Path) -> None:
    saving = GxsmFileWriter(tmp_path, Faults([], FAULT_KINDS, START_S))
    (tmp_path / "scan001-Xp-a.nc").touch()
    number = saving.next_number()
    paths = [saving.free(ending, number) for ending in ("Xp-a.nc", "Xp-b.nc")]
    assert [path.name for path in paths] == ["scan002-Xp-a.nc", "scan001-Xp-b.nc"]
    saving.counted(paths)
    assert saving.named("Xp-a.nc", saving.counter).name == "scan003-Xp-a.nc"


def written(folder: Path, version: int, label: str, real: Path) -> Path:
    """Write the scan of a real file with the emulator."""
    content = read(real)
    (scan,) = content.scans
    channel = next(one for one in CHANNELS[version] if one.label == label and one.direction == "Xp")
    header = content.header
    frame = tuple(float(header[key]) for key in ("offsetx", "offsety", "rangex", "rangey", "alpha"))
    in_channels_unit = np.asarray(scan.values) * (1e10 if scan.unit == "m" else 1.0) / channel.scale
    saved = files.GxsmScanFile(
        str(folder / real.name),
        label,
        channel.raw(in_channels_unit),
        channel.dz,
        channel.unit,
        frame,  # type: ignore[arg-type]
        float(header["t_start"]),
        float(header["t_end"]),
        "SPM-SIM:SPM",
        2.0,
    )
    path = folder / real.name
    path.write_bytes(files.netcdf3(saved) if version == 3 else files.netcdf4(saved))
    return path


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


@needs_data
@pytest.mark.parametrize(("version", "label"), BOTH)
def test_a_scan_written_by_the_emulator_reads_as_the_real_one(tmp_path: Path, version: int, label: str) -> None:
    real = DATA / REAL[version][label]
    ours, theirs = read(written(tmp_path, version, label, real)), read(real)
    (scan,), (true,) = ours.scans, theirs.scans
    assert (scan.channel, scan.unit, scan.region) == (true.channel, true.unit, true.region)
    np.testing.assert_allclose(scan.values, true.values, rtol=1e-6)
    assert (ours.start_ns, ours.end_ns, ours.upwards) == (theirs.start_ns, theirs.end_ns, theirs.upwards)


@needs_data
@pytest.mark.parametrize(("version", "label"), BOTH)
def test_file_has_the_variables_of_a_real_one(tmp_path: Path, version: int, label: str) -> None:
    # Every variable, with the same type, dimensions and byte order.
    real = DATA / REAL[version][label]
    ours = written(tmp_path, version, label, real)
    if version == 3:
        mine, true = netcdf.read(ours), netcdf.read(real)
        assert ours.read_bytes()[:4] == real.read_bytes()[:4]
        assert mine.texts.keys() <= true.texts.keys()
        assert mine.attributes.keys() <= true.attributes.keys()
        for name, variable in mine.variables.items():
            assert variable.dimensions == true.variables[name].dimensions, name
        for axis in ("dimx", "dimy"):
            np.testing.assert_allclose(mine.variables[axis].values, true.variables[axis].values, rtol=1e-6)
        return
    mine_, true_ = _described(ours), _described(real)
    for name, what in mine_.items():
        assert what == true_[name], name


def _described(path: Path) -> dict[str, Any]:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path) as file:
        return {name: (node.dtype.str, () if node.dtype.kind == "S" else node.shape) for name, node in file.items()}


@needs_data
def test_a_spectrum_written_by_the_emulator_reads_as_the_real_one(tmp_path: Path) -> None:
    true = read(DATA / CURVE)
    (curve,) = true.spectra
    columns = {
        f"{name} ({'Å' if unit == 'm' else unit})": curve.values[:, k] * (1e10 if unit == "m" else 1.0)
        for k, (name, unit) in enumerate(zip(curve.names, curve.units, strict=True))
    }
    assert true.end_ns is not None
    saved = files.GxsmSpectrumFile("x", columns, true.end_ns / 1e9, (0.0, 0.0), 0.25, "00.02")
    path = tmp_path / Path(CURVE).name
    path.write_bytes(files.vpdata(saved))
    ours = read(path)
    (mine,) = ours.spectra
    assert (mine.kind, mine.names, mine.units) == (curve.kind, curve.names, curve.units)
    np.testing.assert_allclose(mine.values, curve.values, rtol=1e-9)
    assert ours.end_ns == true.end_ns
    assert ours.header.keys() <= true.header.keys()
