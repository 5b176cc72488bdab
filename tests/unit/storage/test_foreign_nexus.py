"""NeXus files of other programs: what they state is read, and what is missing or ambiguous is named."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from tests.unit.storage.samples import ANGLE_DEG, END_NS, HEIGHT_M, OTHER, REGION, nexus_image

import afspm
from afspm.basics.errors import FileError
from afspm.model import Region, Scan
from afspm.storage.formats import FileContent


def read(path: Path) -> FileContent:
    return afspm.read(path, zone=UTC)


def same(region: Region, angle_rad: float = REGION.angle_rad) -> None:
    np.testing.assert_allclose(region.center_m, REGION.center_m)
    np.testing.assert_allclose(region.size_m, REGION.size_m)
    assert region.angle_rad == pytest.approx(angle_rad)


@pytest.mark.parametrize("suffix", ["nxs", "h5", "hdf5"])
@pytest.mark.parametrize(("unit", "transposed"), [("m", False), ("nm", True)])
def test_turned_image_of_nanonis_is_upright_and_in_its_frame(
    tmp_path: Path, suffix: str, unit: str, *, transposed: bool
) -> None:
    nexus_image(path := tmp_path / f"a.{suffix}", unit=unit, transposed=transposed)
    content = read(path)
    assert [(scan.channel, scan.unit) for scan in content.scans] == [("phase_forward", "deg"), ("z_forward", "m")]
    for scan, expected in zip(content.scans, (OTHER, HEIGHT_M), strict=True):
        np.testing.assert_array_equal(scan.values, expected)
        same(scan.region)
    assert (content.controller, content.start_ns, content.end_ns) == ("Nanonis", END_NS - 80 * 10**9, END_NS)
    assert content.header["entry/definition"] == "NXspm"


def test_image_of_an_unknown_program_is_read_unless_it_is_turned(tmp_path: Path) -> None:
    nexus_image(path := tmp_path / "a.nxs", program="another", angle_deg=0.0)
    for scan in read(path).scans:
        same(scan.region, angle_rad=0.0)
    nexus_image(path, program="another", angle_deg=12.0)
    with pytest.raises(FileError, match="in which sense its scan_angle_x counts"):
        read(path)


def _with_the_offset_as_start(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        region = file["entry/instrument/scan_region"]
        for axis, low in zip("xy", REGION.center_m, strict=True):
            region[f"scan_start_{axis}"][...] = low
        for data in (file["entry/z_forward"], file["entry/phase_forward"]):
            data["signal"][...] = data["signal"][()][::-1]
            for axis in "xy":
                data[axis][...] += float(np.ptp(data[axis][()])) / 2


def test_wrong_axes_of_an_older_program_are_replaced_by_the_scan_region(tmp_path: Path) -> None:
    nexus_image(path := tmp_path / "a.nxs")
    _with_the_offset_as_start(path)
    for scan, expected in zip(read(path).scans, (OTHER, HEIGHT_M), strict=True):
        np.testing.assert_array_equal(scan.values, expected)
        same(scan.region)
    nexus_image(path, program="another", angle_deg=0.0)
    _with_the_offset_as_start(path)
    with pytest.raises(FileError, match="z_forward has a scan region that starts at its centre"):
        read(path)


def curves(path: Path, **columns: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry")
        entry["definition"] = "NXsts"
        sensor = entry.create_group("instrument/piezo")
        sensor.attrs["NX_class"], sensor["x"], sensor["y"] = "NXspm_piezo_sensor", 3e-7, -2e-7
        for name, values in columns.items():
            data = entry.create_group(name)
            data.attrs["NX_class"], data.attrs["signal"], data.attrs["axes"] = "NXdata", "current", ["bias"]
            data["bias"], data["current"] = np.linspace(-1.0, 1.0, len(values)), values
            data["bias"].attrs["units"], data["current"].attrs["units"] = "volt", "ampere / volt"


def test_curves_over_one_axis_are_one_spectrum(tmp_path: Path) -> None:
    one = np.arange(5.0)
    curves(path := tmp_path / "a.nxs", forward=one, backward=-one, coarse=one[:3])
    first, second = sorted(read(path).spectra, key=lambda spectrum: len(spectrum.names), reverse=True)
    assert (first.names, first.units) == (("bias", "backward", "forward"), ("V", "A/V", "A/V"))
    np.testing.assert_allclose(first.values, np.stack([np.linspace(-1, 1, 5), -one, one], 1))
    assert (first.position_m, first.kind) == ((3e-7, -2e-7), "bias spectroscopy")
    assert second.names == ("bias", "coarse")


def test_only_data_of_a_file_has_the_name_of_its_signal(tmp_path: Path) -> None:
    curves(path := tmp_path / "a.nxs", data=np.arange(5.0))
    assert read(path).spectra[0].names == ("bias", "current")


def _without(*names: str) -> Callable[[Any], None]:
    def change(group: Any) -> None:
        for name in names:
            if name in group:
                del group[name]
            else:
                del group.attrs[name]

    return change


def _of_three_dimensions(group: Any) -> None:
    del group["signal"]
    group["signal"] = np.zeros((2, 2, 2))


def _with_uneven_steps(group: Any) -> None:
    group["x"][1] += 1e-9


def _over_energy(group: Any) -> None:
    group["energy"] = group["x"][()]
    group.attrs["axes"] = ["y", "energy"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_without("signal"), "lacks its signal signal"),
        (_without("x"), "lacks its axis x"),
        (_without("axes"), "axes of ()"),
        (_of_three_dimensions, "has 3 dimensions"),
        (_with_uneven_steps, "an axis x without even steps"),
        (_over_energy, "has the axes y, energy, not y and x"),
        (lambda group: group["x"].attrs.pop("units"), "lacks the unit of its axis x"),
        (lambda group: group["x"].attrs.update(units="eV"), "eV can't be converted to m"),
    ],
)
def test_unreadable_data_is_named_and_the_rest_is_read(
    tmp_path: Path, change: Callable[[Any], None], reason: str
) -> None:
    nexus_image(path := tmp_path / "a.nxs")
    with h5py.File(path, "r+") as file:
        change(file["entry/phase_forward"])
    content = read(path)
    assert [scan.channel for scan in content.scans] == ["z_forward"]
    assert reason in content.header["not read"]["entry/phase_forward"]
    with h5py.File(path, "r+") as file:
        change(file["entry/z_forward"])
    with pytest.raises(FileError) as refused:
        read(path)
    assert "entry/z_forward" in str(refused.value)
    assert str(refused.value).count(reason) == 2


def test_file_without_data_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.nxs", "w") as file:
        file["entry/title"] = "nothing measured"
    with pytest.raises(FileError, match="holds no NXdata"):
        read(tmp_path / "a.nxs")


def test_renamed_file_of_a_record_is_read_without_loss(tmp_path: Path) -> None:
    from afspm.record.nexus_writer import FileProvenance, encode_scan

    scan = Scan(REGION, "Height", "m", HEIGHT_M, END_NS, "one.dat")
    (tmp_path / "a.nxs").write_bytes(encode_scan([scan], FileProvenance(END_NS)))
    (found,) = read(tmp_path / "a.nxs").scans
    assert (found.region, found.channel, found.filename) == (REGION, "Height", "one.dat")
    assert math.degrees(found.region.angle_rad) == pytest.approx(ANGLE_DEG)
