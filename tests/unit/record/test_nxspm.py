"""Files of a record have the fields that NXspm and NXsts require; `make test-nexus` runs NeXus' own validator."""

from __future__ import annotations

import json
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from afspm.model import Region, Scan, Spectrum
from afspm.record.nexus_writer import FileProvenance, encode_scan, encode_spectrum
from afspm.storage.formats import read

h5py = pytest.importorskip("h5py")
METADATA = {
    "technique": "STM", "vendor": "SPECS Zurich", "software": "Nanonis", "microscope": "Tyto", "sample": "Au(111)",
    "person": "A. Student", "orcid": "https://orcid.org/0000-0002-1825-0097", "project": "steps",
}  # fmt: skip
KNOWN = FileProvenance(1_773_518_400_000_000_000, None, {"run": "night-1", "metadata": METADATA})
CONTROL = "experiment_instrument/scan_environment/scan_control"
SCAN = Scan(Region((1e-6, -2e-6), (1e-6, 0.5e-6), 0.25), "Height", "m", np.zeros((6, 8)), 0, "")
BIAS = np.linspace(-1.0, 2.0, 31)
SPECTRUM = Spectrum((1e-6, 2e-6), "IV", ("Bias", "Current"), ("V", "A"), np.column_stack((BIAS, BIAS**3)), 0, "")


def opened(image: bytes) -> Any:
    return h5py.File(BytesIO(image), "r")["entry"]


def said(entry: Any, *paths: str) -> list[Any]:
    values = [entry[path][()] for path in paths]
    return [value.decode() if isinstance(value, bytes) else value for value in values]


def test_scan_file_has_all_fields_required_by_nxspm() -> None:
    entry = opened(encode_scan([SCAN], KNOWN))
    assert said(entry, "definition", "experiment_technique") == ["NXspm", "STM"]
    assert entry["definition"].attrs["version"]
    instrument = entry["experiment_instrument"]
    assert said(instrument, "hardware/vendor", "hardware/model", "software/vendor", "software/name") == [
        "SPECS Zurich", "Tyto", "SPECS Zurich", "Nanonis",
    ]  # fmt: skip
    region, mesh = entry[CONTROL]["scan_region"], entry[CONTROL]["mesh_scan"]
    assert said(region, "scan_start_x", "scan_end_x") == pytest.approx([0.5e-6, 1.5e-6])
    assert said(region, "scan_start_y", "scan_end_y") == pytest.approx([-2.25e-6, -1.75e-6])
    assert said(mesh, "scan_points_x", "scan_points_y") == [8, 6]
    assert said(mesh, "step_size_x", "step_size_y") == pytest.approx([1e-6 / 7, 0.5e-6 / 5])
    assert set(region.attrs) == {"NX_class"}


def test_file_names_sample_and_user() -> None:
    entry = opened(encode_scan([SCAN], KNOWN))
    assert said(entry, "sample/name", "user/name", "user/ORCID", "collection_identifier") == [
        "Au(111)", "A. Student", "https://orcid.org/0000-0002-1825-0097", "steps",
    ]  # fmt: skip


def test_unknown_facts_are_left_out() -> None:
    entry = opened(encode_scan([SCAN], replace(KNOWN, facts={})))
    assert {"experiment_technique", "user", "collection_identifier"} & set(entry) == set()
    assert {"hardware", "software"} & set(entry["experiment_instrument"]) == set()


def test_spectrum_over_the_bias_of_a_tunnelling_microscope_follows_nxsts() -> None:
    entry = opened(encode_spectrum(SPECTRUM, KNOWN))
    assert said(entry, "definition", "experiment_technique", "scan_mode") == ["NXsts", "STS", "constant height"]
    sweep = entry["experiment_instrument/bias_spectroscopy_environment/bias_spectroscopy/bias_sweep"]
    region = sweep["scan_region"]
    assert said(region, "scan_start_bias", "scan_end_bias", "scan_range_bias") == [-1.0, 2.0, 3.0]
    assert "scan_offset_bias" not in region, "the bias between sweeps is not known"
    assert said(sweep, "linear_sweep/scan_points_bias", "linear_sweep/step_size_bias") == [31, pytest.approx(0.1)]
    assert said(sweep, "spatial_location/x", "spatial_location/y") == [1e-6, 2e-6]


@pytest.mark.parametrize("back", [BIAS[::-1], BIAS[-2::-1]], ids=["turning point twice", "turning point once"])
def test_bias_sweep_there_and_back_has_the_range_of_the_way_there(back: NDArray[np.float64]) -> None:
    bias = np.concatenate((BIAS, back))
    entry = opened(encode_spectrum(replace(SPECTRUM, values=np.column_stack((bias, bias**3))), KNOWN))
    sweep = entry["experiment_instrument/bias_spectroscopy_environment/bias_spectroscopy/bias_sweep"]
    region = sweep["scan_region"]
    assert said(region, "scan_start_bias", "scan_end_bias", "scan_range_bias") == [-1.0, 2.0, 3.0]
    assert said(sweep, "linear_sweep/scan_points_bias", "linear_sweep/step_size_bias") == [31, pytest.approx(0.1)]
    assert entry["data/bias"].shape == bias.shape


@pytest.mark.parametrize(
    ("spectrum", "technique"),
    [(SPECTRUM, "AFM"), (replace(SPECTRUM, names=("Z", "Force"), units=("m", "N"), kind="force"), "STM")],
    ids=["conductive AFM", "over z"],
)
def test_other_spectrum_follows_nxspm_as_a_scan_of_one_point(spectrum: Spectrum, technique: str) -> None:
    about = replace(KNOWN, facts={"metadata": {**METADATA, "technique": technique}})
    entry = opened(encode_spectrum(spectrum, about))
    assert said(entry, "definition", "experiment_technique") == ["NXspm", technique]
    assert said(entry[CONTROL], "scan_region/scan_start_x", "mesh_scan/scan_points_x") == [1e-6, 1]


def test_readings_of_other_instruments_are_in_the_sample() -> None:
    readings = [
        {
            "name": "cryo.temperature",
            "value": 4.2,
            "unit": "K",
            "target": 4.2,
            "age_s": 0.5,
            "lowest": 4.1,
            "highest": 4.3,
        },
        {"name": "magnet.field", "value": None, "unit": "T", "age_s": None, "reason": "no sensor"},
    ]  # fmt: skip
    entry = opened(encode_scan([SCAN], FileProvenance(0, None, {"instruments": readings})))
    sample = entry["sample"]
    assert (sample["temperature"][()], sample["temperature"].attrs["units"]) == (4.2, "K")
    assert "magnetic_field" not in sample
    sensor = sample["environment/cryo_temperature"]
    assert said(sensor, "value", "target", "lowest", "highest", "value_age") == [4.2, 4.2, 4.1, 4.3, 0.5]
    assert said(sample["environment/magnet_field"], "reason") == ["no sensor"]


@pytest.mark.parametrize("kelvin", [4.2, None], ids=["both sensors", "one sensor without a value"])
def test_sample_has_no_temperature_if_two_instruments_have_one(kelvin: float | None) -> None:
    readings = [
        {"name": "cryo.temperature", "value": kelvin, "unit": "K", "age_s": 0.5},
        {"name": "head.temperature", "value": 77.0, "unit": "K", "age_s": 0.5},
    ]
    sample = opened(encode_scan([SCAN], FileProvenance(0, None, {"instruments": readings})))["sample"]
    assert "temperature" not in sample
    assert said(sample["environment/head_temperature"], "value") == [77.0]


SINGLE = np.array([[0.1, -0.0, np.nan, 3e-30], [1e-9, 7.0, np.inf, -2.5]], np.float32).astype(np.float64)
SINGLE = np.tile(SINGLE, (66, 33))  # the writer compares block by block: the last value is in the second


@pytest.mark.parametrize(
    ("last", "kind"),
    [(-2.5, "<f4"), (0.1, "<f8"), (1e300, "<f8"), (1e-60, "<f8")],
    ids=["single precision", "double precision", "too large for it", "too small for it"],
)
def test_channel_is_in_single_precision_only_if_each_bit_is_read_again(tmp_path: Path, last: float, kind: str) -> None:
    values = SINGLE.copy()
    values[-1, -1] = last
    file = tmp_path / "scan.h5"
    file.write_bytes(encode_scan([replace(SCAN, values=values)], KNOWN))
    assert opened(file.read_bytes())["data/height"].dtype.str == kind
    (found,) = read(file).scans
    assert found.values.dtype == np.float64
    assert found.values.tobytes() == values.tobytes()


def test_scan_recorded_in_double_precision_with_texts_of_any_length_is_read(tmp_path: Path) -> None:
    # as versions before single precision wrote it, in the oldest format of HDF5
    about = {
        "content": "scan", "filename": "s.nc", "time_ns": 5, "began_ns": None, "center_m": [0.0, 0.0],
        "size_m": [1e-6, 1e-6], "angle_rad": 0.0, "frame": "tip",
        "channels": [{"name": "Height", "unit": "m", "field": "height", "time_ns": 5}],
    }  # fmt: skip
    file = tmp_path / "old.h5"
    with h5py.File(file, "w", libver="earliest") as old:
        old.attrs.update(NX_class="NXroot", default="entry", creator="afspm")
        old["entry/afspm/about"], old["entry/vendor/header"] = json.dumps(about), json.dumps({"gain": 2})
        data = old.create_dataset("entry/data/height", data=SINGLE, dtype="<f8")
        data.attrs.update(units="m", long_name="Height")
    content = read(file)
    assert content.scans[0].values.tobytes() == SINGLE.tobytes()
    assert (content.scans[0].filename, content.end_ns, content.header["gain"]) == ("s.nc", 5, 2)


def test_structure_of_a_file_is_small() -> None:
    image = encode_scan([SCAN], KNOWN)
    assert len(image) - SCAN.values.nbytes // 2 < 17_000
