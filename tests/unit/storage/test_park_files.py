"""Park's TIFF files: the emulator's files, judged by Gwyddion if installed, and refusals."""

from __future__ import annotations

import math
import shutil
import subprocess
from pathlib import Path

import gwyfile
import numpy as np
import pytest
from deadlines import DEADLINE_S
from PIL import Image, TiffImagePlugin
from pspylib import tiff

import afspm
from afspm.basics.errors import FileError
from afspm.model import Feedback, Region
from afspm.plugins.park import file_header
from afspm.plugins.park.emulator import files
from afspm.simulation.activities import RETRACE, ScanActivity, SpectrumActivity

REGION = Region((1e-6, -2e-6), (3e-6, 1.5e-6), math.radians(30))
HEIGHTS = np.arange(240.0).reshape(12, 20) * 1e-9
CHANNELS = {"Z Height": ("m", HEIGHTS), "Z Height Retrace": ("m", HEIGHTS + 1e-9), "Phase": ("deg", HEIGHTS * 1e9)}


class Drawn:
    def channels(self, until_s: float | None = None) -> dict[str, tuple[str, np.ndarray]]:
        return CHANNELS


@pytest.fixture
def written(tmp_path: Path) -> dict[str, Path]:
    """Return the files of a scan, by channel and direction."""
    scan = ScanActivity(1, REGION, (12, 20), 0.0, 0.5, True, Feedback(setpoint=0.7), 0.2)
    scan.draw(Drawn())
    for name, content in files.images(scan, 1.7e9, "NCM"):
        (tmp_path / f"{name}.tiff").write_bytes(content)
    return {path.stem: path for path in tmp_path.glob("*.tiff")}


def test_a_channel_is_read_as_it_was_scanned(written: dict[str, Path]) -> None:
    content = afspm.read(written["Z Height_Forward"])
    (scan,) = content.scans
    assert (scan.channel, scan.unit, content.controller, content.upwards) == (
        "Z Height Forward",
        "m",
        "Park NCM",
        True,
    )
    assert scan.region.center_m == pytest.approx(REGION.center_m)
    assert scan.region.size_m == pytest.approx(REGION.size_m)
    assert scan.region.angle_rad == pytest.approx(REGION.angle_rad)
    np.testing.assert_allclose(scan.values, HEIGHTS, atol=1e-13)
    assert content.start_ns == 1.7e18


def test_directions_and_units_are_distinguished(written: dict[str, Path]) -> None:
    (back,), (phase,) = (afspm.read(written[name]).scans for name in ("Z Height_Backward", "Phase_Forward"))
    assert (back.channel, phase.channel, phase.unit) == ("Z Height Backward", "Phase Forward", "deg")
    np.testing.assert_allclose(phase.values, HEIGHTS * 1e9, rtol=1e-6)


SWEPT = np.linspace(-2.0, 2.0, 50) * 1e-7
CURVES = {
    "force": ("Z", "m", {"Force": ("N", SWEPT), f"Force{RETRACE}": ("N", SWEPT + 1e-9)}),
    "IV": ("Bias", "V", {"Current": ("A", SWEPT), f"Current{RETRACE}": ("A", SWEPT + 1e-9), "dI/dV": ("S", SWEPT)}),
}


def curve_file(folder: Path, kind: str) -> Path:
    swept, unit, columns = CURVES[kind]
    names, units = (swept, *columns), (unit, *(one for one, _ in columns.values()))
    values = np.column_stack([SWEPT, *(values for _, values in columns.values())])
    taken = SpectrumActivity(1, kind, (2e-6, -3e-6), 0.0, 1.0, names, units, values)
    path = folder / f"{kind}.tiff"
    path.write_bytes(files.curve(taken, 1.7e9, "CAFM"))
    return path


@pytest.mark.parametrize(("kind", "names"), [("force", ("Z", "Force")), ("IV", ("Bias", "Current", "dI/dV"))])
def test_a_curve_is_read_there_and_back(kind: str, names: tuple[str, ...], tmp_path: Path) -> None:
    content = afspm.read(curve_file(tmp_path, kind))
    (curve,) = content.spectra
    assert not content.scans
    assert (curve.kind, curve.names, content.controller) == (kind, names, "Park CAFM")
    assert curve.units[:2] == (CURVES[kind][1], CURVES[kind][2][names[1]][0])
    assert curve.position_m == pytest.approx((2e-6, -3e-6))
    there, back = (SWEPT[::-1], SWEPT) if kind == "force" else (SWEPT, SWEPT[::-1])
    np.testing.assert_allclose(curve.values[:, 0], [*there, *back], atol=1e-13)
    np.testing.assert_allclose(curve.values[:, 1], [*there, *(back + 1e-9)], atol=1e-13)
    assert curve.in_force == (), "its header states no calibration"


def test_curve_states_the_calibration_of_its_cantilever(tmp_path: Path) -> None:
    path = curve_file(tmp_path, "force")
    with Image.open(path) as image:
        assert isinstance(image, TiffImagePlugin.TiffImageFile)
        raw = bytes(image.tag_v2[file_header.CURVES_TAG])
    header = np.frombuffer(raw[: file_header.CURVES.itemsize], file_header.CURVES).copy()
    header["spring_n_per_m"], header["sensitivity_v_per_um"] = 0.4, 20.0
    path.write_bytes(path.read_bytes().replace(raw, header.tobytes() + (raw[file_header.CURVES.itemsize :])))
    (curve,) = afspm.read(path).spectra
    assert {one.name: (one.constant, one.unit) for one in curve.in_force} == {
        "x-spring-constant": (pytest.approx(0.4), "N/m"),
        "x-sensitivity": (pytest.approx(50e-9), "m/V"),
    }


def test_curves_that_are_not_whole_are_refused(tmp_path: Path) -> None:
    whole = curve_file(tmp_path, "force").read_bytes()
    half = tmp_path / "half.tiff"
    for size in range(0, len(whole) - 1, 97):
        half.write_bytes(whole[:size])
        with pytest.raises(FileError):
            afspm.read(half)


def test_the_makers_own_reader_reads_the_same(written: dict[str, Path], tmp_path: Path) -> None:
    """The reader needs a coloured picture in several strips, which every Park file has."""
    image = tiff.TiffReader(str(written["Z Height_Forward"])).data
    np.testing.assert_allclose(np.reshape(image.scanData.ZData, (12, 20)) * 1e-6, HEIGHTS, atol=1e-13)
    assert len(image.metaData.thumbnail) == HEIGHTS.size
    curve = tiff.TiffReader(str(curve_file(tmp_path, "force"))).data
    gains = [curve.spectHeader.channelInfo[number]["gain"][0] for number in (0, 1)]
    ours = afspm.read(tmp_path / "force.tiff").spectra[0].values
    factors = np.array([1e-6, 1e-9])  # it leaves the units to who asks
    np.testing.assert_allclose((curve.spectData.rawData[0].T * gains) * factors, ours, rtol=1e-6)
    assert curve.spectHeader.spectHeader["spectType"][0] == 2
    point = curve.spectHeader.pointInfo[0]
    assert (point["fPosX"][0], point["fPosY"][0]) == pytest.approx((2.0, -3.0))


@pytest.mark.program
@pytest.mark.skipif(shutil.which("gwyddion") is None, reason="Gwyddion is not installed")
def test_gwyddion_shows_the_same(written: dict[str, Path], tmp_path: Path) -> None:
    converted = tmp_path / "converted.gwy"
    command = ["gwyddion", f"--convert-to-gwy={converted}", str(written["Z Height_Forward"])]
    subprocess.run(command, check=True, capture_output=True, timeout=DEADLINE_S)
    shown = gwyfile.load(str(converted))
    field = shown["/0/data"]
    assert (field["xres"], field["yres"]) == (20, 12)
    assert (field["xreal"], field["yreal"]) == pytest.approx(REGION.size_m)
    np.testing.assert_allclose(field.data[::-1], HEIGHTS, atol=1e-13)  # its rows descend
    assert shown["/0/meta"]["Scanning direction"] == "Bottom to top"
    assert shown["/0/meta"]["Angle"] == "30°"


def test_another_tiff_and_half_a_file_are_refused(written: dict[str, Path], tmp_path: Path) -> None:
    picture = tmp_path / "picture.tif"
    Image.new("L", (4, 4)).save(picture)
    with pytest.raises(FileError, match="not a TIFF of a Park microscope"):
        afspm.read(picture)
    whole = written["Phase_Forward"].read_bytes()
    half = tmp_path / "half.tiff"
    for size in range(0, len(whole) - 1, 97):
        half.write_bytes(whole[:size])
        with pytest.raises(FileError):
            afspm.read(half)
