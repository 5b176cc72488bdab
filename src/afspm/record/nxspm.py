"""The parts of NXspm, and of NXsts for spectra over the bias, except the values: technique, instrument, sample …"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from afspm.basics.plain_data import PlainMapping
from afspm.model import Region, Scan, Spectrum
from afspm.record.nexus_reader import BIAS_SPECTRUM, DEFINITION

if TYPE_CHECKING:
    import h5py

_VERSION: Final = "v2024.02"
"""The version of the NeXus definitions."""
_OF_SAMPLE: Final = {"temperature": "temperature", "field": "magnetic_field", "pressure": "pressure"}
"""Fields of NXsample, by the last word in the name of an instrument parameter."""
_TECHNIQUE, _BIAS_TECHNIQUE = "STM", "STS"
_SHORT: Final = 200
"""Characters of a text that is stored in the heap of the file, which has 4 kB for its first texts."""
_IN_HEADER: Final = 60_000
"""Bytes of a field that HDF5 stores in its header, which has at most 64 kB."""


def definition_of(spectrum: Spectrum, metadata: Mapping[str, str]) -> str:
    """Return the NeXus definition of a spectrum: NXsts for a bias spectrum of a tunnelling microscope, else NXspm."""
    is_over_bias = spectrum.units[:1] == ("V",) and len(spectrum.values) > 0
    is_tunnelling = metadata.get("technique") in (_TECHNIQUE, _BIAS_TECHNIQUE)
    return BIAS_SPECTRUM if is_over_bias and is_tunnelling else DEFINITION


def describe(entry: h5py.Group, definition: str, about: PlainMapping, version: str) -> h5py.Group:
    """Write the facts about the whole file and return the instrument's group; unknown facts are left out."""
    mark(put(entry, "definition", definition), version=_VERSION)
    metadata: Mapping[str, str] = about.get("metadata") or {}
    technique = _BIAS_TECHNIQUE if definition == BIAS_SPECTRUM else metadata.get("technique")
    texts = {
        "experiment_technique": technique,
        "title": about.get("experiment"),
        "collection_identifier": metadata.get("project"),
        "identifier_experiment": about.get("run"),
        "experiment_description": "SIMULATED" if about.get("simulated") else None,
    }
    _write_texts(entry, texts)
    sample = group(entry, "sample", "NXsample")
    put(sample, "name", metadata.get("sample", ""))
    _write_surroundings(sample, about.get("instruments") or [])
    if "person" in metadata or "orcid" in metadata:
        user = group(entry, "user", "NXuser")
        _write_texts(user, {"name": metadata.get("person"), "ORCID": metadata.get("orcid")})
    instrument = group(entry, "experiment_instrument", "NXinstrument")
    if vendor := metadata.get("vendor"):
        hardware = group(instrument, "hardware", "NXfabrication")
        _write_texts(hardware, {"vendor": vendor, "model": metadata.get("microscope")})
        software = group(instrument, "software", "NXfabrication")
        _write_texts(software, {"vendor": vendor, "name": metadata.get("software")})
    mark(put(entry, "program_name", "afspm"), version=version)
    return instrument


def write_frame(instrument: h5py.Group, scan: Scan) -> None:
    """Write region and pixels of a scan; start and end refer to the unrotated frame."""
    rows, columns = scan.shape
    _write_pattern(instrument, scan.region.center_m, scan.region, (columns, rows))


def write_point(instrument: h5py.Group, spectrum: Spectrum) -> None:
    """Write the position of the probe, if known, as a scan of one point."""
    if spectrum.position_m is not None:
        _write_pattern(instrument, spectrum.position_m, None, (1, 1))


def write_bias_sweep(
    entry: h5py.Group, instrument: h5py.Group, spectrum: Spectrum, bias_v: float | None = None
) -> None:
    """Write the sweep of a bias spectrum; `bias_v`: the bias between sweeps, None if it is not known."""
    put(entry, "scan_mode", "constant height")  # the feedback is held while the bias is swept
    environment = group(instrument, "bias_spectroscopy_environment", "NXenvironment")
    spectroscopy = group(environment, "bias_spectroscopy", "NXspm_bias_spectroscopy")
    sweep = group(spectroscopy, "bias_sweep", "NXspm_scan_control")
    put(sweep, "scan_type", "linear")
    bias = spectrum.values[:, 0]
    far = np.abs(bias - bias[0])
    if far[-1] < 0.5 * far.max():  # there and back: the way there, since the ends of the whole sweep are equal
        bias = bias[: int(far.argmax()) + 1]
    first, last, count = float(bias[0]), float(bias[-1]), len(bias)
    region = group(sweep, "scan_region", "NXspm_scan_region")
    values(region, "scan_start_bias", first, "V")
    values(region, "scan_end_bias", last, "V")
    if bias_v is not None:
        values(region, "scan_offset_bias", bias_v, "V")
    values(region, "scan_range_bias", abs(last - first), "V")
    linear = group(sweep, "linear_sweep", "NXspm_scan_pattern")
    put(linear, "scan_points_bias", count)
    values(linear, "step_size_bias", (last - first) / max(1, count - 1), "V")
    if spectrum.position_m is not None:
        place = group(sweep, "spatial_location", "NXcoordinate_system")
        for axis, value in zip("xy", spectrum.position_m, strict=True):
            values(place, axis, value, "m")


def _write_pattern(
    instrument: h5py.Group, center_m: tuple[float, float], region: Region | None, points: tuple[int, int]
) -> None:
    environment = group(instrument, "scan_environment", "NXenvironment")
    control = group(environment, "scan_control", "NXspm_scan_control")
    area, mesh = group(control, "scan_region", "NXspm_scan_region"), group(control, "mesh_scan", "NXspm_scan_pattern")
    size_m = (0.0, 0.0) if region is None else region.size_m
    for axis, center, size, count in zip("xy", center_m, size_m, points, strict=True):
        values(area, f"scan_offset_value_{axis}", center, "m")
        values(area, f"scan_range_{axis}", size, "m")
        values(area, f"scan_start_{axis}", center - size / 2, "m")
        values(area, f"scan_end_{axis}", center + size / 2, "m")
        put(mesh, f"scan_points_{axis}", count)
        if count > 1:
            values(mesh, f"step_size_{axis}", size / (count - 1), "m")
    values(area, "scan_angle_x", 0.0 if region is None else math.degrees(region.angle_rad), "deg")


def _write_surroundings(sample: h5py.Group, readings: Sequence[PlainMapping]) -> None:
    # NXsample has fields of its own for temperature, magnetic field and pressure
    if not readings:
        return
    environment = group(sample, "environment", "NXenvironment")
    for one in readings:
        name = re.sub(r"\W", "_", str(one["name"]))
        sensor = group(environment, name, "NXsensor")
        put(sensor, "name", str(one["name"]))
        for key in ("value", "target", "lowest", "highest"):
            if one.get(key) is not None:
                values(sensor, key, float(one[key]), str(one["unit"]))
        if one.get("age_s") is not None:
            values(sensor, "value_age", float(one["age_s"]), "s")
        _write_texts(sensor, {"reason": one.get("reason")})
    for word, quantity in _OF_SAMPLE.items():
        found = [one for one in readings if re.split(r"\W|_", str(one["name"]))[-1] == word]
        # of two sensors neither is certainly the sample's: the field could show another sensor in the next file
        if len(found) == 1 and found[0].get("value") is not None:
            values(sample, quantity, float(found[0]["value"]), str(found[0]["unit"]))


def group(parent: h5py.Group, name: str, nexus_class: str) -> h5py.Group:
    made = parent.create_group(name)
    mark(made, NX_class=nexus_class)
    return made


def mark(node: h5py.Group | h5py.Dataset, /, **attributes: str | Sequence[str] | float) -> None:
    """Set attributes. Their texts have any length: NeXus' validator fails at classes in texts of fixed length."""
    node.attrs.update(attributes)


def put(parent: h5py.Group, name: str, value: str | float) -> h5py.Dataset:
    """Create a field of one text or number, in the header of the field if it fits."""
    import h5py

    if isinstance(value, float | int):
        data = np.asarray(value)
    elif len(value) <= _SHORT:  # NeXus' validator demands texts of any length for times
        data = np.array(value, dtype=h5py.string_dtype())
    else:
        encoded = value.encode()
        data = np.array(encoded, dtype=h5py.string_dtype("utf-8", len(encoded)))
    if data.nbytes > _IN_HEADER:
        return parent.create_dataset(name, data=data)
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_layout(h5py.h5d.COMPACT)
    kind, space = h5py.h5t.py_create(data.dtype, logical=True), h5py.h5s.create(h5py.h5s.SCALAR)
    made = h5py.h5d.create(parent.id, name.encode(), kind, space, layout)
    made.write(h5py.h5s.ALL, h5py.h5s.ALL, data)
    return h5py.Dataset(made)


def values(
    parent: h5py.Group, name: str, numbers: NDArray[np.floating] | float, unit: str, long_name: str = ""
) -> None:
    """Create a field with its unit: of float32 if the numbers are, else of float64."""
    if isinstance(numbers, int | float):
        dataset = put(parent, name, float(numbers))
    else:
        kind = "<f4" if numbers.dtype == np.float32 else "<f8"
        dataset = parent.create_dataset(name, data=numbers, dtype=kind)
    mark(dataset, units=unit)
    if long_name:
        mark(dataset, long_name=long_name)


def _write_texts(parent: h5py.Group, texts: Mapping[str, str | None]) -> None:
    for name, text in texts.items():
        if text:
            put(parent, name, str(text))
