"""Every format: values, geometry and times are read as the controller meant them."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.unit.storage import samples
from tests.unit.storage.samples import END_NS, HEIGHT_M, OTHER, REGION, WHOLE, gxsm3, gxsm4, sxm

import afspm
from afspm.basics.errors import FileError
from afspm.model import Region
from afspm.storage.formats import FileContent, suffixes

pytest.importorskip("h5py")
pytest.importorskip("scipy")


def read(name: str, folder: Path) -> FileContent:
    WHOLE[name](folder / name)
    return afspm.read(folder / name, zone=UTC)


def same(region: Region, expected: Region) -> None:
    np.testing.assert_allclose(region.center_m, expected.center_m, rtol=1e-9)
    np.testing.assert_allclose(region.size_m, expected.size_m, rtol=1e-9)
    assert region.angle_rad == pytest.approx(expected.angle_rad)


IMAGES = {
    "up.sxm": (("Z Forward", "m", 1), ("Z Backward", "m", -1), ("Current Forward", "A", -1)),
    "down.sxm": (("Z Forward", "m", 1), ("Z Backward", "m", -1), ("Current Forward", "A", -1)),
    "scan.ibw": (("HeightRetrace", "m", 1), ("PhaseRetrace", "deg", -1)),
    "nsid.h5": (("HeightRetrace", "m", 1), ("PhaseRetrace", "deg", -1)),
    "simulated.nc": (("Height Retrace", "m", 1), ("Phase", "deg", -1)),
    "gxsm3.nc": (("Topo", "m", 1),),
    "gxsm4.nc": (("ZS-Topo", "m", 1),),
}


@pytest.mark.parametrize("name", IMAGES)
def test_an_image_has_its_pixels_where_they_were_measured(name: str, tmp_path: Path) -> None:
    content = read(name, tmp_path)
    assert content.spectra == ()
    assert [(scan.channel, scan.unit) for scan in content.scans] == [(n, unit) for n, unit, _ in IMAGES[name]]
    for scan, (_, _, sign) in zip(content.scans, IMAGES[name], strict=True):
        np.testing.assert_allclose(scan.values, HEIGHT_M if sign > 0 else OTHER, rtol=1e-6)
        assert scan.values.dtype == np.float64
        same(scan.region, REGION)
        assert scan.filename == str(tmp_path / name)
    assert content.topography is content.scans[0]
    assert list(content) == list(content.scans)


def _of_another_instrument(path: Path, unit: str, per_m: float) -> Path:
    """NSID without Asylum's note, its axes in another unit."""
    import h5py

    WHOLE["nsid.h5"](path)
    with h5py.File(path, "r+") as file:
        for group in (node for channel in file["Measurement_000"].values() for node in channel.values()):
            del group["original_metadata"]
            for axis in "xy":
                group[axis][...] *= per_m
                group[axis].attrs["units"] = unit
    return path


def test_axes_of_nsid_are_in_their_stated_unit(tmp_path: Path) -> None:
    region = afspm.read(_of_another_instrument(tmp_path / "other.h5", "nm", 1e9), zone=UTC).scans[0].region
    same(region, Region((25e-9, 15e-9), REGION.size_m))
    with pytest.raises(FileError, match="deg"):
        afspm.read(_of_another_instrument(tmp_path / "angles.h5", "deg", 1.0), zone=UTC)


def test_channels_of_one_name_are_numbered(tmp_path: Path) -> None:
    path = tmp_path / "two.sxm"
    path.write_bytes(sxm().replace(b"\t0\tCurrent\tA\tforward", b"\t0\tZ\tm\tforward"))
    first, _, second = afspm.read(path, zone=UTC).scans
    assert (first.channel, second.channel) == ("Z Forward", "Z Forward #2")
    np.testing.assert_allclose(second.values, OTHER, rtol=1e-6)


TIMES = {
    "up.sxm": (80.0, True), "down.sxm": (80.0, False), "scan.ibw": (2.0, False), "nsid.h5": (2.0, False),
    "simulated.nc": (4 * 2 * 50e-9 / 1e-8, False), "gxsm3.nc": (80.0, False), "gxsm4.nc": (80.0, False),
    "spectrum.dat": (80.0, None), "force.ibw": (1.5, None), "simulated-spectrum.nc": (None, None),
    "curve-VP001-VP.vpdata": (None, None), "field.gsf": (None, None),
}  # fmt: skip


@pytest.mark.parametrize("name", TIMES)
def test_time_and_direction_of_a_scan_are_read(name: str, tmp_path: Path) -> None:
    content = read(name, tmp_path)
    lasted_s, upwards = TIMES[name]
    end_ns = None if name == "field.gsf" else END_NS
    assert content.end_ns == end_ns
    assert {one.time_ns for one in content} == {end_ns}
    assert content.upwards is upwards
    if lasted_s is None or end_ns is None:
        assert content.start_ns is None
    else:
        assert content.start_ns == pytest.approx(end_ns - lasted_s * 1e9, abs=1e3)


@pytest.mark.parametrize("name", ["up.sxm", "spectrum.dat", "scan.ibw", "nsid.h5", "curve-VP001-VP.vpdata"])
def test_times_without_a_zone_are_read_in_the_given_zone(name: str, tmp_path: Path) -> None:
    WHOLE[name](tmp_path / name)
    east = afspm.read(tmp_path / name, zone=timezone(timedelta(hours=2)))
    assert east.end_ns == END_NS - 2 * 3600 * 10**9


def test_gwyddion_field_is_turned_upright_and_its_sides_include_whole_pixels(tmp_path: Path) -> None:
    content = read("field.gsf", tmp_path)
    np.testing.assert_allclose(content.scans[0].values, HEIGHT_M, rtol=1e-6)
    same(content.scans[0].region, Region((130e-9, -20e-9), (50e-9, 30e-9)))
    assert (content.scans[0].channel, content.scans[0].unit) == ("Height", "m")


@pytest.mark.parametrize("name", ["gxsm3.nc", "gxsm4.nc"])
def test_attributes_of_a_gxsm_file_are_in_the_header(name: str, tmp_path: Path) -> None:
    header = read(name, tmp_path).header
    assert (header["Creator"], header["Version"]) == (name.removesuffix(".nc"), "1.2.3")
    assert header["rangex"] == 500.0
    assert header["spm_scancontrol"].strip() == "TopDown"


def test_a_bias_spectrum_of_nanonis(tmp_path: Path) -> None:
    (curve,) = read("spectrum.dat", tmp_path).spectra
    assert curve.names == ("Bias calc", "Current", "Current [filt]")
    assert curve.units == ("V", "A", "A")
    assert (curve.kind, curve.position_m) == ("bias spectroscopy", (300e-9, -200e-9))
    expected = [[-1.5, 2e-12, np.nan], [0, 0, 1e-12], [1.5, -2e-12, 1e-12]]
    np.testing.assert_array_equal(curve.values, expected)


@pytest.mark.parametrize(
    ("status", "caption"), [("ON", "lock-in amplitude = 5 mV, lock-in frequency = 727 Hz"), ("OFF", "")]
)
def test_lock_in_of_nanonis_is_in_force(status: str, caption: str, tmp_path: Path) -> None:
    lock_in = {
        "Lock-in status": status,
        "Modulated signal": "Bias (V)",
        "Frequency (Hz)": "727E+0",
        "Amplitude": "5E-3",
    }
    spectrum = "".join(f"Lock-in>{name}\t{value}\t\r\n" for name, value in lock_in.items()).encode()
    scan = "".join(f":Lock-in>{name}:\n{value}\n" for name, value in lock_in.items()).encode()
    (tmp_path / "a.dat").write_bytes(samples.dat().replace(b"[DATA]", spectrum + b"\r\n[DATA]"))
    (tmp_path / "a.sxm").write_bytes(samples.sxm().replace(b":SCANIT_END:", scan + b":SCANIT_END:"))
    assert afspm.read(tmp_path / "a.dat", zone=UTC).spectra[0].caption() == caption
    assert afspm.read(tmp_path / "a.sxm", zone=UTC).scans[0].caption() == caption


@pytest.mark.parametrize(
    ("column", "name", "unit"),
    [
        ("Current PSD (A/sqrt(Hz))", "Current PSD", "A/sqrt(Hz)"),
        ("Current PSD (A/sqrt(Hz)) [filt]", "Current PSD [filt]", "A/sqrt(Hz)"),
        ("Input (left) (V)", "Input (left)", "V"),
        ("Index", "Index", ""),
    ],
)
def test_column_has_the_whole_unit_in_its_last_parentheses(column: str, name: str, unit: str, tmp_path: Path) -> None:
    dat = samples.dat().replace(b"Current (A)\t", column.encode() + b"\t")
    (tmp_path / "a.dat").write_bytes(dat)
    (curve,) = afspm.read(tmp_path / "a.dat", zone=UTC).spectra
    assert (curve.names[1], curve.units[1]) == (name, unit)


def test_column_of_gxsm_keeps_a_unit_with_parentheses_in_it(tmp_path: Path) -> None:
    (tmp_path / "a-VP001-VP.vpdata").write_bytes(samples.vpdata().replace(b"Z-mon (\xc3\x85)", b"PSD (V/sqrt(Hz))"))
    (curve,) = afspm.read(tmp_path / "a-VP001-VP.vpdata", zone=UTC).spectra
    assert (curve.names, curve.units) == (("Bias-mon", "PSD"), ("V", "V/sqrt(Hz)"))


def test_unit_of_gxsm_is_the_unit_and_not_its_name_in_gxsms_own_list(tmp_path: Path) -> None:
    import h5py
    from scipy.io import netcdf_file

    gxsm4(tmp_path / "4.nc")
    with h5py.File(tmp_path / "4.nc", "r+") as file:
        file["FloatField"].attrs.update({"ZSrcUnit": b"mV1", "unit": b"mV1", "var_unit": b"mV", "unit_x_dz": b"mV"})
    gxsm3(tmp_path / "3.nc")
    with netcdf_file(tmp_path / "3.nc", "a") as other:
        field: Any = other.variables["FloatField"]
        field.ZSrcUnit, field.unit = b"mV1", b"mV"
    for name in ("4.nc", "3.nc"):
        assert afspm.read(tmp_path / name).scans[0].unit == "mV"


def test_a_force_curve_of_asylum(tmp_path: Path) -> None:
    content = read("force.ibw", tmp_path)
    (curve,) = content.spectra
    assert (curve.names, curve.units) == (("Raw", "Defl", "Time"), ("m", "m", "s"))
    assert (curve.kind, curve.position_m) == ("force", (1e-6, -2e-6))
    np.testing.assert_array_equal(curve.values, [[0, 0.125, 0], [0.25, 0.375, 0.5], [0.5, 0.625, 1.0]])
    assert content.header["StartHeadTemp"] == "30 °C"


def test_probe_data_of_gxsm(tmp_path: Path) -> None:
    (curve,) = read("curve-VP001-VP.vpdata", tmp_path).spectra
    assert (curve.names, curve.units) == (("Bias-mon", "Z-mon"), ("V", "m"))
    assert (curve.kind, curve.position_m) == ("VP", None)
    np.testing.assert_allclose(curve.values, [[-1.5, 1e-9], [0, 2e-9], [1.5, 3e-9]])


@pytest.mark.parametrize("make", [gxsm3, gxsm4])
def test_rows_that_a_stopped_scan_has_not_reached_are_not_a_number(make: object, tmp_path: Path) -> None:
    make(tmp_path / "a.nc", 2)  # type: ignore[operator]
    (scan,) = afspm.read(tmp_path / "a.nc").scans
    assert np.isnan(scan.values[:2]).all()  # it went down
    np.testing.assert_allclose(scan.values[2:], HEIGHT_M[2:], rtol=1e-6)


def test_a_signal_that_was_zero_stays_zero(tmp_path: Path) -> None:
    gxsm4(tmp_path / "a.nc", 4)
    assert (afspm.read(tmp_path / "a.nc").scans[0].values == 0.0).all()


@pytest.mark.parametrize("name", ["scan.xyz", "scan", "scan.npy"])
def test_a_format_without_a_reader_is_refused_with_those_there_are(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"anything")
    with pytest.raises(FileError, match=r"\.sxm"):
        afspm.read(tmp_path / name)


@pytest.mark.parametrize("name", ["folder", "scan.xyz"])
def test_missing_file_is_not_blamed_on_its_suffix(name: str, tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no such file"):
        afspm.read(tmp_path / name)


@pytest.mark.parametrize("suffix", suffixes())
def test_missing_or_other_file_is_refused_by_its_name(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    with pytest.raises(FileError, match="no such file"):
        afspm.read(path)
    for content in (b"", b"not a scan", b"\0" * 1000, b"CDF\x01" + b"\xff" * 60, b"\x89HDF\r\n\x1a\n" + b"\xff" * 900):
        path.write_bytes(content)
        with pytest.raises(FileError) as refused:
            afspm.read(path)
        assert str(path) in str(refused.value)


def test_an_igor_wave_with_a_damaged_header_is_refused(tmp_path: Path) -> None:
    WHOLE["scan.ibw"](tmp_path / "a.ibw")
    data = bytearray((tmp_path / "a.ibw").read_bytes())
    data[150] ^= 1  # of the size of a pixel
    (tmp_path / "a.ibw").write_bytes(data)
    with pytest.raises(FileError, match="checksum"):
        afspm.read(tmp_path / "a.ibw")


def test_nothing_is_loaded_that_a_file_does_not_need(tmp_path: Path) -> None:
    (tmp_path / "a.sxm").write_bytes(sxm())
    code = (
        "import sys, afspm; afspm.read(sys.argv[1]);"
        "print([m for m in ('scipy', 'h5py', 'igor2', 'skimage', 'pint') if m in sys.modules])"
    )
    out = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.sxm")], capture_output=True, encoding="utf-8", check=True
    )
    assert out.stdout.strip() == "[]"


@pytest.mark.parametrize("mode", ["r", "r+", "a"])
@pytest.mark.parametrize("locking", [None, True, False, "best-effort"])
def test_hdf5_file_that_this_process_has_open_is_read(tmp_path: Path, mode: str, locking: bool | str | None) -> None:
    # contributors K3, results X7
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "nsid.h5"
    WHOLE["nsid.h5"](path)
    expected = afspm.read(path).scans[0].values
    with h5py.File(path, mode, locking=locking):
        np.testing.assert_array_equal(afspm.read(path).scans[0].values, expected)
    np.testing.assert_array_equal(afspm.read(path).scans[0].values, expected)
