"""The position of a sample's feature in a scan: axes, frame, drift, rotation, order of lines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.model import Frame, Region
from afspm.simulation import World

QUIET = {
    "white_m": 0.0, "one_over_f_m": 0.0, "line_offset_m": 0.0, "scar_probability": 0.0,
    "amplitude_v": 0.0, "phase_deg": 0.0, "current_a": 0.0,
}  # fmt: skip
# Gentle hills, a tip that is a needle to them: the height must be that of the sample, wherever the pixel is.
HILLS = {
    "surface": {"kind": "rough", "largest_m": 300e-9, "smallest_m": 150e-9, "rms_m": 5e-9},
    "tip": {"radius_m": 1e-9},
    "feedback": {"integral_gain": 5000.0},
    "noise": QUIET,
}


def hills(**more: Any) -> World:
    return World.from_settings({**HILLS, **more}, seed=11, start_s=1000.0)


def height(world: World, region: Region, shape: tuple[int, int] = (48, 64), start_s: float = 1000.0, **how: Any) -> Any:
    return world.scan(region, shape, 1.0, start_s, **how).channels()["Height"][1]


def relative_error(measured: Any, expected: Any) -> float:
    return float(np.std(measured - expected) / np.std(expected))


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, -120.0])
@pytest.mark.parametrize("center", [(0.0, 0.0), (1.3e-6, -0.7e-6)])
def test_pixel_shows_the_sample_at_its_position(angle_deg: float, center: tuple[float, float]) -> None:
    world = hills()
    region = Region(center, (900e-9, 500e-9), np.radians(angle_deg))
    values = height(world, region)
    x, y = region.pixels_m(values.shape)
    expected = world.sample.surface_m(x, y)
    assert relative_error(values, expected) < 0.05
    for wrong in (values[::-1], values[:, ::-1], values[::-1, ::-1]):
        assert relative_error(wrong, expected) > 0.3
    half_a_frame = world.sample.surface_m(x + region.size_m[0] / 2, y + region.size_m[1] / 2)
    assert relative_error(values, half_a_frame) > 0.3


def test_position_error_is_far_below_a_pixel() -> None:
    world = hills()
    region = Region((0.0, 0.0), (900e-9, 500e-9))
    values = height(world, region, (96, 128))
    x, y = region.pixels_m(values.shape)
    pixel = 900e-9 / 127
    errors = {s: relative_error(values, world.sample.surface_m(x + s * pixel, y)) for s in (-0.25, 0.0, 0.25)}
    assert errors[0.0] < errors[-0.25]
    assert errors[0.0] < errors[0.25]


def test_drift_displaces_the_sample_in_the_scan() -> None:
    # x_tip = x_sample + drift: a pixel at x shows the sample at x - drift
    drift = {"relaxing": [{"total_m": [310e-9, -120e-9, 0.0], "time_s": 1.0}]}  # over long before the scan
    world = hills(drift=drift)
    region = Region((0.0, 0.0), (900e-9, 500e-9))
    values = height(world, region, start_s=5000.0)
    x, y = region.pixels_m(values.shape)
    assert relative_error(values, world.sample.surface_m(x - 310e-9, y + 120e-9)) < 0.05
    assert relative_error(values, world.sample.surface_m(x + 310e-9, y - 120e-9)) > 0.3


@pytest.mark.parametrize("direction", ["up", "down"])
def test_every_row_has_the_drift_of_its_own_time(direction: str) -> None:
    world = hills(drift={"velocity_m_per_s": [4e-9, 2e-9, 0.0]})
    region = Region((0.0, 0.0), (900e-9, 500e-9))
    scan = world.scan(region, (48, 64), 1.0, 1010.0, direction=direction)
    x, y = region.pixels_m((48, 64))
    row = np.arange(48) if direction == "up" else np.arange(48)[::-1]
    since = (10.0 + row + 0.25)[:, None]
    expected = world.sample.surface_m(x - 4e-9 * since, y - 2e-9 * since)
    assert relative_error(scan.channels()["Height"][1], expected) < 0.05
    np.testing.assert_allclose(scan.drift_m[:, 0], 4e-9 * since[:, 0], atol=1e-15)
    assert relative_error(scan.channels()["Height"][1], world.sample.surface_m(x - 4e-9 * (58 - since), y)) > 0.3


TURNS = {"rotation_rad_per_s": 2e-3, "expansion_per_s": -5e-5, "about_m": [1.2e-6, -0.4e-6]}


def turned(x: Any, y: Any, since_s: Any) -> tuple[Any, Any]:
    """Return positions of the sample after `TURNS`, written out."""
    scale, angle, (x0, y0) = np.exp(-5e-5 * since_s), 2e-3 * since_s, (1.2e-6, -0.4e-6)
    cos, sin = scale * np.cos(angle), scale * np.sin(angle)
    return x0 + cos * (x - x0) - sin * (y - y0), y0 + sin * (x - x0) + cos * (y - y0)


@pytest.mark.parametrize("start_s", [1000.0, 3000.0])
def test_rotating_and_shrinking_sample_is_seen_turned_and_smaller(start_s: float) -> None:
    # row by row: the sample moves during the scan
    world = hills(drift={"velocity_m_per_s": [0.3e-9, 0.2e-9, 0.0], **TURNS})
    on_sample = Region((-0.5e-6, 0.8e-6), (900e-9, 500e-9))
    since_s = start_s - 1000.0 + (np.arange(48) + 0.25)[:, None]
    x, y = turned(*on_sample.center_m, start_s - 1000.0)
    region = Region((float(x), float(y)), on_sample.size_m)
    values = height(world, region, start_s=start_s)
    x, y = region.pixels_m(values.shape)
    times_s = np.broadcast_to(1000.0 + since_s, x.shape)
    at = world.sample.to_sample(np.stack([x, y], axis=-1), times_s)
    back = np.stack(turned(at[..., 0], at[..., 1], since_s), axis=-1)
    drift = np.stack([0.3e-9 * since_s, 0.2e-9 * since_s], axis=-1)
    np.testing.assert_allclose(back + drift, np.stack([x, y], axis=-1), atol=1e-16)
    np.testing.assert_allclose(world.sample.to_tip(at, times_s), np.stack([x, y], axis=-1), atol=1e-16)
    assert relative_error(values, world.sample.surface_m(at[..., 0], at[..., 1])) < 0.05
    at_first = world.sample.to_sample(np.stack([x, y], axis=-1), np.full(x.shape, start_s))
    assert relative_error(values, world.sample.surface_m(at_first[..., 0], at_first[..., 1])) > 0.3


def test_marks_are_made_at_the_rotated_position_of_the_sample() -> None:
    world = hills(drift=TURNS)
    world.compensate((1e-10, 0.0), 1500.0)
    world.crash((2e-6, 1e-6), 10e-9, 1e-6, 3000.0)
    truth: dict[str, Any] = world.truth(3000.0)
    on_sample_x, on_sample_y = truth["marks"][0]["sample_xy_m"]
    x, y = turned(on_sample_x, on_sample_y, 2000.0)
    np.testing.assert_allclose((x, y), (2e-6 + 150e-9, 1e-6), atol=1e-15)
    assert truth["turn"]["angle_rad"] == pytest.approx(4.0 - 2.0 * np.pi)
    assert truth["turn"]["scale"] == pytest.approx(np.exp(-0.1))
    assert truth["turn"]["about_m"] == [1.2e-6, -0.4e-6]


def test_expansion_beyond_any_sample_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"expansion_per_s: 0\.01 is not between -0\.0001 and 0\.0001 1/s"):
        hills(drift={"expansion_per_s": 1e-2})
    with pytest.raises(ConfigError, match="rotation_rad_per_s"):
        hills(drift={"rotation_rad_per_s": float("nan")})


def test_z_drift_raises_the_later_rows() -> None:
    world = World.from_settings(
        {"surface": "flat", "noise": QUIET, "drift": {"velocity_m_per_s": [0.0, 0.0, 1e-9]}}, seed=1, start_s=0.0
    )
    values = height(world, Region((0.0, 0.0), (1e-6, 1e-6)), (20, 20), start_s=0.0)
    assert values[-1].mean() - values[0].mean() == pytest.approx(19e-9, rel=0.01)


def test_trace_and_retrace_show_the_same_place() -> None:
    world = hills()
    channels = world.scan(Region((0.0, 0.0), (900e-9, 500e-9)), (48, 64), 1.0, 1000.0).channels()
    assert relative_error(channels["Height"][1], channels["Height Retrace"][1]) < 0.05
    assert {name: unit for name, (unit, _) in channels.items()} == {
        "Height": "m", "Height Retrace": "m", "Amplitude": "V", "Phase": "deg", "Current": "A",
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["steps", "particles", "stamper", "rough"])
def test_zoom_agrees_with_the_wide_scan(kind: str) -> None:
    world = World.from_settings({"surface": kind, "noise": QUIET, "tip": {"radius_m": 2e-9}}, seed=4, start_s=0.0)
    wide = height(world, Region((0.0, 0.0), (2e-6, 2e-6)), (201, 201), start_s=0.0)
    zoom = height(world, Region((0.25e-6, -0.25e-6), (1e-6, 1e-6)), (201, 201), start_s=0.0)
    seen, closer = wide[25:126, 75:176], zoom[::2, ::2]
    assert np.corrcoef(seen.ravel(), closer.ravel())[0, 1] > 0.98
    assert np.corrcoef(seen[::-1].ravel(), closer.ravel())[0, 1] < 0.9


def test_rows_not_yet_scanned_are_missing() -> None:
    world = hills()
    region = Region((0.0, 0.0), (900e-9, 500e-9))
    up = world.scan(region, (10, 12), 2.0, 1000.0)
    assert up.end_s == 1020.0
    taken = ~np.isnan(up.channels(until_s=1007.0)["Height"][1]).any(axis=1)
    assert taken.tolist() == [True] * 3 + [False] * 7
    down = world.scan(region, (10, 12), 2.0, 1020.0, direction="down")
    taken = ~np.isnan(down.channels(until_s=1027.0)["Current"][1]).any(axis=1)
    assert taken.tolist() == [False] * 7 + [True] * 3


def test_slope_compensation_removes_the_tilt() -> None:
    scanner = {"tilt_x": 0.05, "tilt_y": -0.02}
    world = World.from_settings({"surface": "flat", "noise": QUIET, "scanner": scanner}, seed=1, start_s=0.0)
    region = Region((3e-6, 1e-6), (1e-6, 1e-6))
    tilted = height(world, region, (20, 20), start_s=0.0)
    assert np.ptp(tilted) == pytest.approx(0.07 * 1e-6, rel=0.05)
    level = height(world, region, (20, 20), start_s=0.0, slope=(0.05, -0.02))
    assert np.ptp(level) < 0.02 * np.ptp(tilted)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (2, 3)])
def test_scans_of_few_pixels_are_taken(shape: tuple[int, int]) -> None:
    for _, values in hills().scan(Region((0.0, 0.0), (1e-7, 1e-7)), shape, 1.0, 1000.0).channels().values():
        assert values.shape == shape
        assert np.isfinite(values).all()


def test_impossible_scan_is_refused() -> None:
    world, region = hills(), Region((0.0, 0.0), (1e-6, 1e-6))
    before = world.state()
    for arguments in (
        (region, (0, 10), 1.0, 1000.0), (region, (100_000, 100_000), 1.0, 1000.0), (region, (9, 9), 0.0, 1000.0),
        (region, (9, 9), float("nan"), 1000.0), (region, (9, 9), 1.0, 999.0),
        (Region((0.0, 0.0), (1e-6, 1e-6), frame=Frame.SAMPLE), (9, 9), 1.0, 1000.0),
    ):  # fmt: skip
        with pytest.raises(InvalidValue):
            world.scan(*arguments)
    with pytest.raises(InvalidValue):
        world.scan(region, (9, 9), 1.0, 1000.0, direction="left")
    with pytest.raises(InvalidValue):
        world.scan(region, (9, 9), 1.0, 1000.0, bias_v=float("nan"))
    assert world.state() == before


@pytest.mark.parametrize(
    ("surface", "size", "condition", "angle"),
    [("particles", (20e-9, 20e-9), "blunt", 0.0), ("particles", (60e-6, 60e-6), "double", 0.3),
     ("stamper", (100e-6, 1e-9), "sharp", 0.7), ("lattice", (1e-5, 1e-5), "blunt", 0.0)],
)  # fmt: skip
def test_odd_scans_use_a_grid_of_limited_size(
    surface: str, size: tuple[float, float], condition: str, angle: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    from afspm.simulation import measuring

    points: list[int] = []
    grid = measuring._grid

    def counted(*arguments: Any) -> Any:
        made = grid(*arguments)
        points.append(made[0].shape[0] * made[0].shape[1])
        return made

    monkeypatch.setattr(measuring, "_grid", counted)
    world = World.from_settings({"surface": surface, "tip": {"condition": condition}}, seed=1, start_s=0.0)
    values = height(world, Region((0.0, 0.0), size, angle), (128, 128), start_s=0.0)
    assert np.isfinite(values).all()
    assert points[0] < 4_400_000
