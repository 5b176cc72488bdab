from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.dashboard.levelling import Levelling, levelled
from afspm.dashboard.palettes import LEVELS, PALETTES, UNMEASURED, colours
from afspm.dashboard.pictures import Contrast, Span, indices, png, span_of
from afspm.dashboard.profiles import profile
from afspm.model import Region

BUMP = np.exp(-((np.arange(40) - 20.0) ** 2) / 8)[:, None] * np.exp(-((np.arange(60) - 30.0) ** 2) / 8)


def tilted(values: np.ndarray) -> np.ndarray:
    rows, columns = (np.arange(n) for n in values.shape)
    return values + 3.0 + 0.7 * rows[:, None] - 0.2 * columns[None, :]


def test_a_plane_is_taken_off_whole() -> None:
    assert np.abs(levelled(tilted(np.zeros((40, 60))), Levelling.PLANE)).max() < 1e-12


def test_what_lies_on_a_plane_keeps_its_height() -> None:
    flat = levelled(BUMP, Levelling.PLANE)
    assert np.allclose(levelled(tilted(BUMP), Levelling.PLANE), flat, atol=1e-12)


def test_line_by_line_takes_each_lines_own_slope_and_offset() -> None:
    rows = np.random.default_rng(1).normal(size=(30, 2, 1))
    values = rows[:, 0] + rows[:, 1] * np.arange(50)
    assert np.abs(levelled(values, Levelling.LINES)).max() < 1e-12
    assert np.abs(levelled(values, Levelling.PLANE)).max() > 0.1


def test_no_levelling_is_what_was_published() -> None:
    values = tilted(BUMP)
    assert levelled(values, Levelling.NONE) is values


@pytest.mark.parametrize("how", [Levelling.PLANE, Levelling.LINES])
def test_lines_that_have_not_come_count_for_nothing(how: Levelling) -> None:
    values = tilted(BUMP)
    growing = values.copy()
    growing[12:] = np.nan
    assert np.allclose(levelled(growing, how)[:12], levelled(values[:12], how), atol=1e-12)
    assert np.isnan(levelled(growing, how)[12:]).all()


@pytest.mark.parametrize("how", list(Levelling))
@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (0, 4), (2, 2)])
def test_the_smallest_scans_can_be_levelled(how: Levelling, shape: tuple[int, int]) -> None:
    assert np.isfinite(levelled(np.ones(shape), how)).all()


@pytest.mark.parametrize("how", list(Levelling))
def test_a_scan_without_a_value_stays_without(how: Levelling) -> None:
    assert np.isnan(levelled(np.full((4, 5), np.nan), how)).all()


def test_the_span_leaves_outliers_out_if_wanted() -> None:
    values = np.linspace(0.0, 1.0, 10_000).reshape(100, 100)
    values[50, 50] = 1e6
    robust, full = span_of(values, Contrast.ROBUST), span_of(values, Contrast.FULL)
    assert robust.high < 1.1
    assert full.high == 1e6


def test_the_span_of_a_large_scan_is_found_from_all_of_its_columns() -> None:
    values = np.tile(np.arange(1024.0), (1024, 1))
    span = span_of(values, Contrast.ROBUST)
    assert span.low < 10
    assert span.high > 1013


@pytest.mark.parametrize("values", [np.full((3, 3), 2.5), np.full((3, 3), np.nan), np.zeros((0, 3))])
def test_there_is_always_a_span(values: np.ndarray) -> None:
    span = span_of(values, Contrast.ROBUST)
    assert span.high > span.low


def test_indices_go_from_the_lowest_to_the_highest_colour() -> None:
    found = indices(np.array([[0.0, 0.5, 1.0], [-9.0, 9.0, np.nan]]), Span(0.0, 1.0))
    assert found.tolist() == [[0, 127, LEVELS - 1], [0, LEVELS - 1, UNMEASURED]]


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_any_value_has_an_index(value: float) -> None:
    assert indices(np.array([[value]]), Span(-1.0, 1.0)).dtype == np.uint8


def decoded(data: bytes) -> tuple[tuple[int, int], np.ndarray, np.ndarray]:
    """(width, height), rows of indices as they are in the file, palette: read without our own code."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + body)
        chunks[kind], at = body, at + 12 + length
    width, height, depth, colour = struct.unpack(">IIBB", chunks[b"IHDR"][:10])
    assert (depth, colour) == (8, 3)
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, width + 1)
    assert not rows[:, 0].any()
    return (width, height), rows[:, 1:], np.frombuffer(chunks[b"PLTE"], np.uint8).reshape(-1, 3)


def test_the_first_row_of_the_picture_is_the_highest_y() -> None:
    levels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    size, rows, palette = decoded(png(levels, "gold"))
    assert size == (4, 3)
    assert rows.tolist() == levels[::-1].tolist()
    assert (palette[:LEVELS] == colours("gold")).all()


@pytest.mark.parametrize("name", PALETTES)
def test_colours_grow_lighter_with_the_value(name: str) -> None:
    luminance = colours(name) @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(luminance) >= -0.5).all()
    assert luminance[-1] - luminance[0] > 180


def test_a_profile_has_lengths_in_metres_and_the_values_on_the_line() -> None:
    region = Region((0.0, 0.0), (2e-6, 1e-6))
    values = np.arange(21.0)[None, :] + 100 * np.arange(11.0)[:, None]
    found = profile(values, region, (0.0, 0.0), (20.0, 10.0))
    assert found.distances_m[0] == 0.0
    assert found.distances_m[-1] == pytest.approx(np.hypot(2e-6, 1e-6))
    assert found.values[0] == 0.0
    assert found.values[-1] == 1020.0
    assert np.allclose(np.diff(found.values), np.diff(found.values)[0])


def test_a_profile_beyond_the_border_ends_at_the_border() -> None:
    found = profile(np.arange(9.0).reshape(3, 3), Region((0, 0), (1e-6, 1e-6)), (-5.0, 1.0), (50.0, 1.0))
    assert found.values.tolist() == [3.0, 4.0, 5.0]


def test_a_profile_over_lines_that_have_not_come_is_not_spoilt_beside_them() -> None:
    values = np.ones((4, 4))
    values[2:] = np.nan
    found = profile(values, Region((0, 0), (1e-6, 1e-6)), (0.0, 1.0), (3.0, 1.0))
    assert found.values.tolist() == [1.0] * 4
    assert np.isnan(profile(values, Region((0, 0), (1e-6, 1e-6)), (0.0, 3.0), (3.0, 3.0)).values).all()
