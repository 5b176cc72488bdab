"""Files of Nanosurf's programs: the maker's examples, if installed, and the emulator's files."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import afspm
from afspm.basics.errors import FileError
from afspm.model import Region
from afspm.plugins.nanosurf.emulator import files
from afspm.simulation.activities import SpectrumActivity
from afspm.simulation.instrument import SimulatedInstrument

pytest.importorskip("h5py")
NSFOPEN = importlib.util.find_spec("NSFopen")
EXAMPLES = Path(NSFOPEN.origin).parent / "example" if NSFOPEN is not None and NSFOPEN.origin else Path("/nowhere")


def example(name: str) -> Path:
    path = EXAMPLES / name
    if not path.is_file():
        pytest.skip("NSFopen, with the maker's examples, is not installed")
    return path


START_S = 1.7e9


def scanned(folder: Path, *, upwards: bool = True) -> tuple[Path, SimulatedInstrument]:
    """Return a file of the emulator, and the simulated instrument."""
    rig = SimulatedInstrument({"surface": "steps"}, 3, START_S)
    rig.setup.region, rig.setup.shape = Region((40e-9, -25e-9), (300e-9, 100e-9), np.deg2rad(30)), (6, 10)
    rig.setup.upwards = upwards
    path = folder / "scan.nhf"
    path.write_bytes(files.image(rig.start_scan(START_S), 1.7e9, "dynamic_mode"))
    return path, rig


@pytest.mark.parametrize("upwards", [True, False])
def test_an_image_comes_back_as_it_was_scanned(tmp_path: Path, *, upwards: bool) -> None:
    path, rig = scanned(tmp_path, upwards=upwards)
    content = afspm.read(path)
    assert rig.scan is not None
    heights = rig.scan.channels()["Height"][1]
    (found,) = [scan for scan in content.scans if scan.channel == "Height Forward"]
    np.testing.assert_allclose(found.values, heights, atol=1e-9 * np.ptp(heights))
    np.testing.assert_allclose(found.region.center_m, rig.scan.region.center_m)
    assert (found.unit, found.region.angle_rad) == ("m", pytest.approx(rig.scan.region.angle_rad))
    assert content.upwards is upwards
    assert content.end_ns == 1_700_000_000_000_000_000


@pytest.mark.filterwarnings("ignore")  # of the maker's reader, about pandas
def test_nsfopen_reads_the_same_heights_and_curves(tmp_path: Path) -> None:
    """NSFopen assumes a range about zero for each channel, as in a file of a real Studio."""
    reading = pytest.importorskip("NSFopen.read")
    path, rig = scanned(tmp_path)
    assert rig.scan is not None
    data = reading.read(str(path)).data["Image"]
    for way, suffix in (("Forward", ""), ("Backward", " Retrace")):
        heights = rig.scan.channels()[f"Height{suffix}"][1]
        np.testing.assert_allclose(np.asarray(data[way]["Height"], float), heights, atol=1e-9 * np.ptp(heights))
    taken = SimulatedInstrument({"surface": "steps"}, 3, START_S).start_spectrum("force", START_S)
    path = tmp_path / "curve.nhf"
    path.write_bytes(files.curves([taken], (1, 1), 1.7e9, "dynamic_mode"))
    data = reading.read(str(path)).data["Image"]
    deflection = taken.values[:, taken.names.index("Deflection")]
    read = np.asarray(data["Forward"]["Deflection"], float).ravel()
    np.testing.assert_allclose(read, deflection[::-1], atol=1e-9 * np.ptp(deflection))


def test_lines_that_were_not_scanned_are_missing(tmp_path: Path) -> None:
    rig = SimulatedInstrument({"surface": "steps"}, 3, START_S)
    rig.setup.shape = (6, 10)
    scan = rig.start_scan(START_S)
    scan.stopped_s = scan.start_s + 2.5 * scan.line_s
    path = tmp_path / "partial.nhf"
    path.write_bytes(files.image(scan, scan.stopped_s, "dynamic_mode"))
    assert {one.lines_missing for one in afspm.read(path).scans} == {4}


def test_a_curve_goes_there_and_back(tmp_path: Path) -> None:
    rig = SimulatedInstrument({"surface": "steps"}, 3, START_S)
    taken: SpectrumActivity = rig.start_spectrum("force", START_S)
    path = tmp_path / "curve.nhf"
    path.write_bytes(files.curves([taken], (1, 1), 1.7e9, "dynamic_mode"))
    (curve,) = afspm.read(path).spectra
    z = taken.values[:, taken.names.index("Z")]
    np.testing.assert_allclose(curve["Z"], np.concatenate([z[::-1], z]), atol=1e-15)
    back = taken.values[:, taken.names.index("Deflection Retrace")]
    np.testing.assert_allclose(curve["Deflection"][len(z) :], back, atol=1e-9 * np.ptp(back))


def test_image_of_the_maker_is_read() -> None:
    content = afspm.read(example("Calculate_Roughness/sapphire.nid"))
    assert content.controller == "Nanosurf 3.8.3.5"
    assert [scan.channel for scan in content.scans][:2] == ["Z-Axis forward", "Amplitude forward"]
    heights = content.scans[0]
    assert (heights.values.shape, heights.unit, heights.region.size_m) == ((256, 256), "m", (2.5e-6, 2.5e-6))
    # as Gwyddion 2.62 shows it, where the first row is the upper one
    assert heights.values.min() == pytest.approx(-3.4497025077044964e-06)
    assert heights.values.max() == pytest.approx(-3.3933982e-06, rel=1e-4)
    assert content.upwards is True


def test_rotated_image_of_the_maker_is_read() -> None:
    region = afspm.read(example("Plane_Removal/grid.nid")).scans[0].region
    assert region.center_m == (1.2982e-06, -1.65728e-07)
    assert np.degrees(region.angle_rad) == pytest.approx(45.0)


@pytest.mark.filterwarnings("ignore")  # of the maker's reader, about pandas
def test_the_makers_force_curves_are_what_the_makers_reader_finds() -> None:
    reading = pytest.importorskip("NSFopen.read")
    path = example("Force_Spectroscopy/spectroscopy.nid")
    theirs = reading.read(str(path)).data["Spec"]
    spectra = afspm.read(path).spectra
    assert len(spectra) == 100
    for number in (0, 1, 57):
        both = np.concatenate([theirs[way]["Deflection"][number] for way in ("Forward", "Backward")])
        np.testing.assert_allclose(spectra[number]["Deflection"], both)
    assert spectra[0].units[:2] == ("m", "N")


def test_a_file_that_ends_early_is_refused(tmp_path: Path) -> None:
    whole = example("Plane_Removal/circles.nid").read_bytes()
    path = tmp_path / "half.nid"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileError, match="ends within DataSet-"):
        afspm.read(path)


@pytest.mark.filterwarnings("ignore")  # of the maker's reader, about pandas
def test_heights_of_a_real_studio_agree_with_nsfopen() -> None:
    """Of format 1; its channels have a range about zero, as those of the emulator."""
    nanosurf = importlib.util.find_spec("nanosurf")
    folder = Path(nanosurf.origin if nanosurf is not None and nanosurf.origin else "/").parent
    path = folder / "apps" / "wavemode_nma_analysis" / "example_data" / "SBS-PS_example_data.nhf"
    if not path.is_file():
        pytest.skip("nanosurf-apps, with a file of a real Studio, is not installed")
    import h5py

    with h5py.File(path) as file:
        stored = file["measurement_0/segment_0/dataset_0"]
        low, high = (float(stored.attrs[f"base_calibration_{end}"]) for end in ("min", "max"))
        heights = stored[:].reshape(100, 100) * ((high - low) / 2 / (2**31 - 1))  # as in NSFopen 2.2.4
    assert low == -high
    (ours,) = [scan for scan in afspm.read(path).scans if scan.channel == "Topography Forward"]
    np.testing.assert_allclose(ours.values, heights, atol=1e-14)
    assert (ours.unit, ours.region.size_m) == ("m", (1e-5, 1e-5))


def tuning(lines: int = 1) -> bytes:
    """Return a file of thermal tuning: a spectrum over the frequency and its fit, without images."""
    channel = (
        f"Version=2\r\nPoints=5\r\nLines={lines}\r\nDim0Name=Frequency\r\nDim0Unit=Hz\r\nDim0Range=200000\r\n"
        "Dim0Min=1000\r\nDim1Range=0\r\nDim2Name=Amplitude Spectral Density\r\nDim2Unit=m/sqrt(Hz)\r\n"
        "Dim2Range=2e-12\r\nDim2Min=-1e-12\r\nSaveBits=32\r\n"
    )
    head = (
        "[DataSet]\r\nGroupCount=2\r\nGr0-Ch0=DataSet-0:0\r\nGr1-Ch0=DataSet-1:0\r\n\r\n[DataSet-0:0]\r\n"
        f"Frame=Spectrum FFT\r\n{channel}\r\n[DataSet-1:0]\r\nFrame=Spectrum Fit\r\n{channel}\r\n"
    )
    densities = np.arange(5 * lines) * 2**26
    return head.encode() + b"#!" + densities.astype("<i4").tobytes() + (2 * densities).astype("<i4").tobytes()


@pytest.mark.parametrize("lines", [1, 2])
def test_spectrum_over_the_frequency_alone_is_read(tmp_path: Path, lines: int) -> None:
    path = tmp_path / "thermal.nid"
    path.write_bytes(tuning(lines))
    content = afspm.read(path)
    assert content.scans == ()
    assert [one.kind for one in content.spectra] == ["Spectrum FFT"] * lines + ["Spectrum Fit"] * lines
    for number, one in enumerate(content.spectra):
        assert (one.names, one.units) == (("Frequency", "Amplitude Spectral Density"), ("Hz", "m/sqrt(Hz)"))
        assert one.position_m is None
        np.testing.assert_allclose(one["Frequency"], [1e3, 51e3, 101e3, 151e3, 201e3])
        step, first = (1 + number // lines) * 2.0**-5 * 1e-12, 5 * (number % lines)
        np.testing.assert_allclose(one["Amplitude Spectral Density"], step * np.arange(first, first + 5), atol=1e-27)
