from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from afspm.drawing.image_html import data_url, round_length_m, scale_bar, shown
from afspm.drawing.palette import LEVELS, UNMEASURED, colour_map
from afspm.drawing.raster import Contrast, ValueRange, indices, png, reduced, shared_range, value_range
from afspm.model.line_levelling import Levelling, flattened, levelled

BUMP = np.exp(-((np.arange(40) - 20.0) ** 2) / 8)[:, None] * np.exp(-((np.arange(60) - 30.0) ** 2) / 8)


def tilted(values: np.ndarray) -> np.ndarray:
    rows, columns = (np.arange(n) for n in values.shape)
    raised: np.ndarray = values + 3.0 + 0.7 * rows[:, None] - 0.2 * columns[None, :]
    return raised


def test_plane_levelling_removes_a_plane_completely() -> None:
    assert np.abs(levelled(tilted(np.zeros((40, 60))), Levelling.PLANE)).max() < 1e-12


def test_plane_levelling_keeps_heights_above_the_plane() -> None:
    flat = levelled(BUMP, Levelling.PLANE)
    assert np.allclose(levelled(tilted(BUMP), Levelling.PLANE), flat, atol=1e-12)


def test_line_levelling_removes_slope_and_offset_of_each_line() -> None:
    rows = np.random.default_rng(1).normal(size=(30, 2, 1))
    values = rows[:, 0] + rows[:, 1] * np.arange(50)
    assert np.abs(levelled(values, Levelling.LINES)).max() < 1e-12
    assert np.abs(levelled(values, Levelling.PLANE)).max() > 0.1


def test_no_levelling_keeps_the_published_values() -> None:
    values = tilted(BUMP)
    assert levelled(values, Levelling.NONE) is values


@pytest.mark.parametrize("how", [Levelling.PLANE, Levelling.LINES])
def test_missing_lines_are_ignored_by_levelling(how: Levelling) -> None:
    values = tilted(BUMP)
    growing = values.copy()
    growing[12:] = np.nan
    assert np.allclose(levelled(growing, how)[:12], levelled(values[:12], how), atol=1e-12)
    assert np.isnan(levelled(growing, how)[12:]).all()


@pytest.mark.parametrize("how", list(Levelling))
@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (0, 4), (2, 2)])
def test_smallest_scans_can_be_levelled(how: Levelling, shape: tuple[int, int]) -> None:
    assert np.isfinite(levelled(np.ones(shape), how)).all()


@pytest.mark.parametrize("how", list(Levelling))
def test_scan_without_a_value_stays_without(how: Levelling) -> None:
    assert np.isnan(levelled(np.full((4, 5), np.nan), how)).all()


def test_robust_range_excludes_outliers() -> None:
    values = np.linspace(0.0, 1.0, 10_000).reshape(100, 100)
    values[50, 50] = 1e6
    robust, full = value_range(values, Contrast.ROBUST), value_range(values, Contrast.FULL)
    assert robust.high < 1.1
    assert full.high == 1e6


def test_range_of_a_large_scan_samples_all_columns() -> None:
    values = np.tile(np.arange(1024.0), (1024, 1))
    span = value_range(values, Contrast.ROBUST)
    assert span.low < 11
    assert span.high > 1012


@pytest.mark.parametrize("values", [np.full((3, 3), 2.5), np.full((3, 3), np.nan), np.zeros((0, 3))])
def test_range_exists_for_any_values(values: np.ndarray) -> None:
    span = value_range(values, Contrast.ROBUST)
    assert span.high > span.low


def test_indices_go_from_the_lowest_to_the_highest_colour() -> None:
    found = indices(np.array([[0.0, 0.5, 1.0], [-9.0, 9.0, np.nan]]), ValueRange(0.0, 1.0))
    assert found.tolist() == [[0, 127, LEVELS - 1], [0, LEVELS - 1, UNMEASURED]]


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_any_value_has_an_index(value: float) -> None:
    assert indices(np.array([[value]]), ValueRange(-1.0, 1.0)).dtype == np.uint8


def test_png_begins_with_the_highest_y_and_unmeasured_pixels_are_transparent() -> None:
    levels = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 254, UNMEASURED]], np.uint8)
    read = Image.open(io.BytesIO(png(levels, "gold")))
    assert (read.format, read.mode, read.size) == ("PNG", "P", (4, 3))
    rgba = np.asarray(read.convert("RGBA"))
    assert (rgba[..., 3] == np.where(levels == UNMEASURED, 0, 255)[::-1]).all()
    assert (rgba[::-1, :, :3][levels != UNMEASURED] == colour_map("gold")[levels[levels != UNMEASURED]]).all()


@pytest.mark.parametrize("small", [True, False])
def test_thumbnail_is_small_and_brightest_at_the_highest_values(small: bool) -> None:
    values = np.tile(np.linspace(0.0, 1.0, 1000), (600, 1))
    values[-4:] = np.nan
    image = shown(values, 256, small=small)
    read = Image.open(io.BytesIO(image.image)).convert("RGBA")
    assert read.size == (250, 200)  # each side by itself: it is drawn in the proportions of its region
    pixels = np.asarray(read).astype(int)
    assert pixels[0, :, 3].max() == 0  # not measured
    assert pixels[-1, 0, 0] < pixels[-1, 125, 0] < pixels[-1, -1, 0]
    assert data_url(image.image).startswith(f"data:image/{'webp' if small else 'png'};base64,")
    assert (image.span.low, image.span.high) == pytest.approx((0.0, 1.0), abs=0.02)


def test_reduced_image_has_means_of_blocks_without_missing_pixels() -> None:
    values = np.arange(36.0).reshape(6, 6)
    values[0, 0] = np.nan
    values[:3, 3:] = np.nan
    few = reduced(values, 2)
    assert few.shape == (2, 2)
    assert few[0, 0] == pytest.approx(np.nanmean(values[:3, :3]))
    assert np.isnan(few[0, 1])
    assert reduced(values, 6) is values


def test_scale_bar_has_a_round_length() -> None:
    assert [round_length_m(length) for length in (9.9e-7, 1e-6, 3.3e-9)] == pytest.approx([5e-7, 1e-6, 2e-9])
    assert "width:20%" in scale_bar((1e-6, 1e-6))
    assert "200 nm" in scale_bar((1e-6, 1e-6))


def test_rows_are_aligned_by_their_differences_beside_a_pit_that_is_longer_than_half_a_row() -> None:
    pit = np.zeros((20, 40))
    pit[5:12, 10:] = -1.0
    steps = np.random.default_rng(3).normal(size=(20, 1))
    by_differences = levelled(pit[:, :28] + steps, Levelling.DIFFERENCES)
    assert np.ptp(levelled((pit + steps)[5:12], Levelling.DIFFERENCES)[:, :10]) < 1e-12
    assert np.ptp(by_differences[12:, 0]) < 1e-12


def test_flattening_is_not_disturbed_by_a_scar() -> None:
    rows = np.cumsum(np.random.default_rng(2).normal(size=40))[:, None]
    scarred = tilted(BUMP + rows)
    scarred[17, 5:25] += 50.0
    flat = flattened(scarred)
    unscarred = flattened(tilted(BUMP + rows))
    assert np.abs(np.delete(flat - unscarred, 17, axis=0)).max() < 0.05
    assert np.ptp(flattened(tilted(rows + np.zeros((40, 60))))) < 1e-9


def test_shared_range_contains_every_picture() -> None:
    low, high = np.linspace(0.0, 1.0, 10_000).reshape(100, 100), np.linspace(0.5, 3.0, 10_000).reshape(100, 100)
    span = shared_range([low, high])
    assert (span.low, span.high) == (value_range(low).low, value_range(high).high)


def test_robust_range_is_from_the_1st_to_the_99th_percentile() -> None:
    span = value_range(np.linspace(0.0, 100.0, 10_201).reshape(101, 101))
    assert (span.low, span.high) == (pytest.approx(1.0, abs=0.02), pytest.approx(99.0, abs=0.02))
