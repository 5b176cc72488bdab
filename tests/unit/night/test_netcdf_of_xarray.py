"""What `to_xarray` returns can be written by `to_netcdf` with scipy, the only engine of the extra, and read again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from record_lab import Night

import afspm
from afspm.model import Region, Scan, ScanSet, Spectrum
from afspm.night.run import Run
from afspm.night.spectrum_stack import stacked
from afspm.record.store import RecordStore

xarray = pytest.importorskip("xarray")
TURNED = Region((1e-6, -2e-6), (4e-7, 2e-7), 0.5)
SCAN = Scan(TURNED, "Height", "m", np.arange(12.0).reshape(3, 4), 1_773_518_400_123_456_789, "one.dat")
TABLES: dict[str, Callable[[Run], Any]] = {
    "scans": lambda run: run.scans,
    "no scans": lambda run: run.scans[:0],
    "spectra": lambda run: run.spectra,
    "journal": lambda run: run.journal,
    "control": lambda run: run.control,
    "log": lambda run: run.log,
}


def grid() -> list[Spectrum]:
    places = np.stack([axis.ravel() for axis in TURNED.pixels_m((2, 3))], 1)
    swept = np.linspace(-1.0, 1.0, 4)
    values = [np.stack([swept, number * swept], 1) for number in range(6)]
    times = [SCAN.time_ns + 7_000_000_001 * number for number in range(6)] if SCAN.time_ns else []
    return [
        Spectrum((float(x), float(y)), "IV", ("Bias", "Current"), ("V", "A"), one, time_ns)
        for (x, y), one, time_ns in zip(places, values, times, strict=True)
    ]


def written(made: Any, folder: Path) -> Any:
    made.to_netcdf(folder / "a.nc", engine="scipy")
    with xarray.open_dataset(folder / "a.nc", engine="scipy") as file:
        return file.load()


@pytest.mark.parametrize("name", TABLES)
def test_table_is_written_and_read_with_exact_times(
    name: str, night: Night, store: RecordStore, tmp_path: Path
) -> None:
    night.now_ns += 123_456_789
    store.take([night.control(), *night.whole_scan(1), night.spectrum(), *night.whole_scan(2)])
    with afspm.open_run(tmp_path) as run:
        table = TABLES[name](run).to_xarray()
    found = written(table, tmp_path)
    assert set(found.variables) == set(table.variables)
    for column in table.variables:
        np.testing.assert_array_equal(found[column].values.astype(table[column].dtype), table[column].values)


def test_large_whole_numbers_are_written(tmp_path: Path) -> None:
    from afspm.night.netcdf_encoding import fit_classic_netcdf

    numbers = np.array([1, 2**40 + 1, -(2**50)])
    assert (written(fit_classic_netcdf(xarray.Dataset({"n": ("row", numbers)})), tmp_path).n == numbers).all()


def test_scans_of_a_turned_frame_have_the_place_of_each_pixel(tmp_path: Path) -> None:
    for made in (SCAN.to_xarray(), ScanSet([SCAN]).to_xarray()):
        found = written(made, tmp_path)
        np.testing.assert_array_equal(found.Height.values, SCAN.values)
        for name, places_m in zip(("x_m", "y_m"), TURNED.pixels_m((3, 4)), strict=True):
            np.testing.assert_array_equal(made[name].values, places_m)
            np.testing.assert_array_equal(found[name].values, places_m)
    straight = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", SCAN.values)
    assert set(straight.to_xarray().coords) == {"x", "y"}


@pytest.mark.parametrize("position_m", [None, (1e-6, 2e-6)])
def test_spectrum_is_written_with_and_without_a_position(
    tmp_path: Path, position_m: tuple[float, float] | None
) -> None:
    one = Spectrum(position_m, "IV", ("Bias", "Current"), ("V", "A"), np.arange(6.0).reshape(3, 2))
    found = written(one.to_xarray(), tmp_path)
    np.testing.assert_array_equal(found.Current, one["Current"])
    assert ("position_m" in found.attrs) == (position_m is not None)


def test_turned_grid_is_written_with_times_and_places(tmp_path: Path) -> None:
    spectra = grid()
    found = written(stacked(spectra).to_xarray(), tmp_path)
    times = [one.time_ns for one in spectra]
    np.testing.assert_array_equal(found.time.values.ravel().astype("datetime64[ns]").astype(np.int64), times)
    places = np.stack([found.x_m.values.ravel(), found.y_m.values.ravel()], 1)
    np.testing.assert_allclose(places, [one.position_m for one in spectra if one.position_m], rtol=1e-9)
