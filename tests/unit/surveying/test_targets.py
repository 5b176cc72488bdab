"""Particles are found at their places on uneven ground, and none on bare ground."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.unit.surveying.surfaces import SIDE_M, Ground, scanned, strewn

from afspm.components.surveying import find_particles, lowest_beside, nearest
from afspm.components.surveying.targets import Target, flattened
from afspm.model import Region

pytest.importorskip("skimage")

PIXEL_M = SIDE_M / 127
TILTED, ROUGH = Ground(slope=0.03), Ground(hills_m=5e-9)
EVERYTHING = Ground(slope=0.03, hills_m=5e-9, lines_m=2e-9, noise_m=1e-9, scars=3)


def at(*places_m: tuple[float, float]) -> np.ndarray:
    return np.array(places_m)


@pytest.mark.parametrize("ground", [Ground(), TILTED, ROUGH, Ground(lines_m=2e-9), Ground(noise_m=2e-9), EVERYTHING])
def test_the_highest_particles_are_found_within_a_pixel(ground: Ground) -> None:
    hits = found = missed = 0
    for seed in range(4):
        places, radii = strewn(seed)
        targets = find_particles(scanned(places, radii, ground, seed=seed), 10, separation_m=200e-9)
        distances = [np.hypot(*(places - target.position_m).T).min() for target in targets]
        hits, found = hits + sum(distance < PIXEL_M for distance in distances), found + len(targets)
        inside = np.abs(places).max(axis=1) < SIDE_M / 2 - PIXEL_M
        highest = places[inside][np.argsort(-radii[inside])[:7]]  # of ten: heights that are nearly equal change places
        missed += sum(nearest(targets, tuple(place), PIXEL_M) is None for place in highest)
    assert found == 40
    assert hits >= 39
    assert missed <= 2


@pytest.mark.parametrize("ground", [Ground(), TILTED, ROUGH, Ground(scars=5), EVERYTHING])
def test_on_bare_ground_nothing_is_found(ground: Ground) -> None:
    for seed in range(4):
        assert find_particles(scanned(np.empty((0, 2)), np.empty(0), ground, seed=seed)) == []


def test_particles_are_sorted_by_height() -> None:
    scan = scanned(at((-1e-6, 0.0), (1e-6, 1e-6), (0.0, -1e-6)), np.array([60e-9, 90e-9, 75e-9]), TILTED)
    targets = find_particles(scan)
    assert [round(1e6 * target.position_m[0]) for target in targets] == [1, 0, -1]
    assert [target.height for target in targets] == pytest.approx([180e-9, 150e-9, 120e-9], rel=0.12)
    assert len(find_particles(scan, 2)) == 2
    assert len(find_particles(scan, min_height=140e-9)) == 2


def test_touching_particles_are_two_unless_nearer_than_the_separation() -> None:
    scan = scanned(at((0.0, 0.0), (260e-9, 0.0)), np.array([80e-9, 95e-9]))
    assert len(find_particles(scan)) == 2
    (only,) = find_particles(scan, separation_m=300e-9)
    assert math.dist(only.position_m, (260e-9, 0.0)) < PIXEL_M


def test_particle_with_its_top_beyond_the_border_is_left_out() -> None:
    scan = scanned(at((SIDE_M / 2 + 20e-9, 0.0), (1e-6, 0.0)), np.array([90e-9, 60e-9]))
    assert [round(target.position_m[0] * 1e6) for target in find_particles(scan)] == [1]


def test_positions_follow_the_rotation_and_centre_of_the_scan() -> None:
    region = Region((3e-6, -2e-6), (SIDE_M, SIDE_M), math.radians(30))
    (target,) = find_particles(scanned(at((3.5e-6, -1e-6)), np.array([80e-9]), region=region))
    assert math.dist(target.position_m, (3.5e-6, -1e-6)) < PIXEL_M / 2


def test_missing_pixels_are_no_target() -> None:
    scan = scanned(at((-1e-6, -1e-6), (1e-6, 1e-6)), np.array([60e-9, 80e-9]))
    values = scan.values.copy()
    values[80:] = np.nan
    (target,) = find_particles(replace(scan, values=values))
    assert math.dist(target.position_m, (-1e-6, -1e-6)) < PIXEL_M


def test_a_particle_that_fills_its_zoom_is_found_in_its_middle() -> None:
    region = Region((10e-9, -15e-9), (400e-9, 400e-9))
    zoom = scanned(at((0.0, 0.0)), np.array([80e-9]), Ground(slope=0.02), region=region)
    found = find_particles(zoom, min_height=60e-9, separation_m=200e-9, widest_m=SIDE_M)
    assert math.dist(found[0].position_m, (0.0, 0.0)) < 5e-9


def test_place_beside_a_particle_avoids_its_neighbours() -> None:
    region = Region((0.0, 0.0), (600e-9, 600e-9))
    zoom = scanned(at((0.0, 0.0), (200e-9, 0.0), (-200e-9, 0.0)), np.array([50e-9] * 3), TILTED, region=region)
    x, y = lowest_beside(zoom, (0.0, 0.0), 200e-9)
    assert math.hypot(x, y) == pytest.approx(200e-9)
    assert abs(y) > 120e-9
    corner = lowest_beside(zoom, (250e-9, 250e-9), 200e-9)
    assert region.contains(corner)


def test_the_ground_of_a_flattened_scan_is_at_zero() -> None:
    places, radii = strewn(1)
    flat = flattened(scanned(places, radii, EVERYTHING), 2)
    assert abs(np.median(flat)) < 1e-12
    assert np.ptp([np.median(line) for line in flat]) < 4e-9


def test_nearest_is_none_if_all_are_too_far() -> None:
    targets = [Target((0.0, 0.0)), Target((3.0, 0.0))]
    assert nearest(targets, (2.0, 0.0), 1.5) == targets[1]
    assert nearest(targets, (9.0, 0.0), 1.5) is None
