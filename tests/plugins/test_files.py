"""Files of the simulated controller: exact round trips, readable by other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm import read
from afspm.basics import FileError
from afspm.driver import FileFacts, encode_scan, encode_spectrum
from afspm.model import Region, Scan, Spectrum

REGION = Region((1.1e-7, -3.3e-7), (1e-6, 0.7e-6), 0.3)
MEASURED = FileFacts(1_767_225_600_123_456_789, {"scan-speed [m/s]": 1e-6, "x-spec-kind": "IV"})
CHANNELS = {
    "Height Retrace": ("m", np.random.default_rng(1).normal(size=(3, 5))),
    "Phase": ("deg", np.full((3, 5), np.nan)),
}


def test_scan_survives_a_round_trip_exactly(tmp_path: Path) -> None:
    (tmp_path / "a.nc").write_bytes(encode_scan(REGION, CHANNELS, MEASURED))
    scans = read(tmp_path / "a.nc")
    for scan, (channel, (unit, values)) in zip(scans, CHANNELS.items(), strict=True):
        assert isinstance(scan, Scan)
        assert (scan.region, scan.channel, scan.unit, scan.time_ns) == (REGION, channel, unit, MEASURED.time_ns)
        assert np.array_equal(scan.values, values, equal_nan=True)


def test_spectrum_survives_a_round_trip_exactly(tmp_path: Path) -> None:
    values = np.random.default_rng(2).normal(size=(4, 2))
    spectrum = Spectrum((1e-9, -2e-9), "IV", ("Bias", "Current"), ("V", "A"), values)
    (tmp_path / "a.nc").write_bytes(encode_spectrum(spectrum, MEASURED))
    (back,) = read(tmp_path / "a.nc")
    assert isinstance(back, Spectrum)
    assert (back.position_m, back.kind, back.names, back.units) == (
        (1e-9, -2e-9),
        "IV",
        ("Bias", "Current"),
        ("V", "A"),
    )
    assert np.array_equal(back.values, values)


def test_another_reader_sees_the_same(tmp_path: Path) -> None:
    scipy_io: Any = pytest.importorskip("scipy.io")
    (tmp_path / "a.nc").write_bytes(encode_scan(REGION, CHANNELS, MEASURED))
    with scipy_io.netcdf_file(tmp_path / "a.nc", mmap=False) as file:
        assert np.array_equal(file.variables["height_retrace"].data, CHANNELS["Height Retrace"][1])
        assert file.variables["height_retrace"].dimensions == ("y", "x")
        assert file.variables["height_retrace"].long_name == b"Height Retrace"
        assert file.variables["x"].data[0] == pytest.approx(REGION.top_left_m[0])
        assert file.region_angle_rad == 0.3
        assert file.time_ns == b"1767225600123456789"


def test_every_truncated_file_is_refused(tmp_path: Path) -> None:
    content = encode_scan(REGION, CHANNELS, MEASURED)
    path = tmp_path / "half.nc"
    for length in [*range(0, 700, 7), len(content) // 2, len(content) - 1]:
        path.write_bytes(content[:length])
        with pytest.raises(FileError):
            read(path)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"none\.nc"):
        read(tmp_path / "none.nc")
