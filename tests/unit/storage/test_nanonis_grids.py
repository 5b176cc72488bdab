"""Grids of spectra of Nanonis (.3ds): geometry, units, sweeps of both kinds, and grids that were stopped."""

from __future__ import annotations

from datetime import UTC
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.unit.storage.corpus import reading
from tests.unit.storage.samples import (
    END_NS,
    GRID_COLUMNS,
    GRID_POINTS,
    GRID_ROWS,
    REGION,
    SEGMENTS,
    grid,
)

import afspm
from afspm.basics.errors import FileError
from afspm.night.spectrum_stack import stacked
from afspm.storage.formats import FileContent

SHAPE = (GRID_ROWS, GRID_COLUMNS)
PLACES = np.stack([axis.ravel() for axis in REGION.pixels_m(SHAPE)], axis=1)
RECORD = 4 * (7 + 2 * GRID_POINTS)


def places(content: FileContent) -> np.ndarray:
    found = [one.position_m for one in content.spectra if one.position_m is not None]
    assert len(found) == len(content.spectra)
    return np.array(found)


def read(path: Path, content: bytes) -> FileContent:
    path.write_bytes(content)
    return afspm.read(path, zone=UTC)


@pytest.mark.parametrize("positions", [True, False], ids=["with positions", "positions from the frame"])
def test_spectra_of_a_turned_grid_lie_where_they_were_measured(tmp_path: Path, *, positions: bool) -> None:
    content = read(tmp_path / "a.3ds", grid(positions=positions))
    np.testing.assert_allclose(places(content), PLACES, rtol=1e-6)
    for number, one in enumerate(content.spectra):
        assert (one.kind, one.names) == ("bias spectroscopy", ("Bias calc", "Current", "Current [bwd]"))
        assert one.units == ("V", "A", "A")
        currents = (100 * number + np.arange(GRID_POINTS)) * 1e-12
        np.testing.assert_allclose(one.values, np.stack([np.linspace(1, -1, 5), currents, -currents], 1), rtol=1e-6)
    assert (content.start_ns, content.end_ns) == (END_NS - 80 * 10**9, END_NS)
    assert content.header["Comment"] == "at 4.4 K, 30 °"


def test_values_measured_once_at_each_point_are_scans(tmp_path: Path) -> None:
    content = read(tmp_path / "a.3ds", grid())
    assert [(scan.channel, scan.unit) for scan in content.scans] == [("Z", "m"), ("Scan:Current", "A")]
    assert content.topography is content.scans[0]
    np.testing.assert_allclose(content.scans[0].values, 1e-9 * np.arange(6).reshape(SHAPE), rtol=1e-6)
    for scan in content.scans:
        np.testing.assert_allclose(scan.region.center_m, REGION.center_m)
        np.testing.assert_allclose(scan.region.size_m, REGION.size_m)
        assert scan.region.angle_rad == pytest.approx(REGION.angle_rad)


def test_grid_is_stacked_with_both_directions(tmp_path: Path) -> None:
    stack = stacked(read(tmp_path / "a.3ds", grid()).spectra)
    assert stack.directions == ("forward", "backward")
    assert stack.points.angle_rad == pytest.approx(REGION.angle_rad, rel=1e-4)
    expected = (100 * np.arange(6)[:, None] + np.arange(GRID_POINTS)) * 1e-12
    np.testing.assert_allclose(stack.curves["Current"][:, :, 0, 0].reshape(6, -1), expected, rtol=1e-6)
    np.testing.assert_allclose(stack.curves["Current"][:, :, 0, 1].reshape(6, -1), -expected, rtol=1e-6)


@given(st.integers(1, len(grid())))
def test_cut_off_grid_has_its_whole_spectra_or_is_refused(missing: int) -> None:
    # users N10: one record that is cut must not cost the others
    count = (6 * RECORD - missing) // RECORD
    if count < 1:
        with pytest.raises(FileError, match="incomplete"):
            reading(grid()[:-missing], "a.3ds")
        return
    content = reading(grid()[:-missing], "a.3ds")
    assert len(content.spectra) == count
    named = (f"the record of point {count + 1}: the file ends in it",)
    assert content.left_out == (named if missing % RECORD else ())
    np.testing.assert_array_equal(np.isnan(content.scans[0].values).ravel(), np.arange(6) >= count)


def test_sweep_of_several_segments_shares_the_point_between_two(tmp_path: Path) -> None:
    segments = "-1E+0,0E+0,10E-3,100E-3,2;0E+0,300E-3,10E-3,100E-3,4"
    content = read(tmp_path / "a.3ds", grid(entries={"Filetype": "MLS", SEGMENTS: segments}))
    np.testing.assert_allclose(content.spectra[0]["Bias calc"], [-1.0, 0.0, 0.1, 0.2, 0.3], atol=1e-12)


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"Filetype": "MLS"}, "lacks the segments"),
        ({"Filetype": "MLS", SEGMENTS: "-1,0,1E-2,1E-1,5;0,1,1E-2,1E-1,5"}, "5, 5 points do not form a sweep of 5"),
        ({"Fixed parameters": '"First;Last"'}, "the swept values are unknown"),
        ({"# Parameters (4 byte)": "8"}, "names 7 parameters, not 8"),
        ({"Grid dim": '"0 x 3"'}, "a grid of 0 x 3 points"),
        ({"Grid dim": '"2 x 2"'}, "is incomplete"),
        ({"Channels": ""}, "holds no spectra"),
    ],
)
def test_refused_grid_has_the_true_reason(tmp_path: Path, entries: dict[str, str], reason: str) -> None:
    with pytest.raises(FileError, match=reason):
        read(tmp_path / "a.3ds", grid(entries=entries))


def test_grid_of_one_line_has_positions_and_no_scans(tmp_path: Path) -> None:
    content = read(tmp_path / "a.3ds", grid(entries={"Grid dim": '"6 x 1"'}))
    assert content.scans == ()
    np.testing.assert_allclose(places(content), PLACES, rtol=1e-6)
    content = read(tmp_path / "b.3ds", grid(positions=False, entries={"Grid dim": '"6 x 1"'}))
    assert {one.position_m for one in content.spectra} == {None}


def test_swept_signal_of_another_kind_keeps_its_name(tmp_path: Path) -> None:
    (one, *_) = read(tmp_path / "a.3ds", grid(entries={"Sweep Signal": '"Frequency (Hz)"'})).spectra
    assert (one.kind, one.names[0], one.units[0]) == ("Grid Spectroscopy", "Frequency", "Hz")
