"""Files of the emulated GXSM, compared with real ones: same content, read the same way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from benchmarks import data_folder

from afspm.plugins.gxsm.emulator import files
from afspm.plugins.gxsm.emulator.files import CHANNELS
from afspm.storage.formats import netcdf, read

DATA = data_folder.DATA / "gxsm"
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


@pytest.mark.parametrize(("version", "label"), BOTH)
def test_a_scan_written_by_the_emulator_reads_as_the_real_one(tmp_path: Path, version: int, label: str) -> None:
    real = DATA / REAL[version][label]
    ours, theirs = read(written(tmp_path, version, label, real)), read(real)
    (scan,), (true,) = ours.scans, theirs.scans
    assert (scan.channel, scan.unit, scan.region) == (true.channel, true.unit, true.region)
    np.testing.assert_allclose(scan.values, true.values, rtol=1e-6)
    assert (ours.start_ns, ours.end_ns, ours.upwards) == (theirs.start_ns, theirs.end_ns, theirs.upwards)


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
    with h5py.File(path) as file:
        return {name: (node.dtype.str, () if node.dtype.kind == "S" else node.shape) for name, node in file.items()}


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
