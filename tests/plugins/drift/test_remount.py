"""A sample that was mounted again is found by its overview, or is reported as not found."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from record_lab import ABOUT, Night
from tests.unit.report.test_measured_tables import start
from typer.testing import CliRunner

from afspm import open_run
from afspm.basics import InvalidValue
from afspm.cli.app import app
from afspm.model import Region, Scan, ScopeState
from afspm.plugins.drift.frame.remount import Remount, find, overview_of
from afspm.record.store import RecordStore
from afspm.simulation.surfaces import surface_from

PX = 64
FRAME = Region((3e-7, -5e-7), (3e-6, 3e-6))
TODAY = Region((1e-7, 2e-7), (3e-6, 3e-6), math.radians(10.0))
TURN_RAD, OFFSET_M = math.radians(-137.0), (4e-7, -3e-7)
SLIGHT_RAD = math.radians(13.0)  # is found by a search among few angles
WITHIN = ("--within", "16")


def scanned(
    region: Region, noise: int, *, turn_rad: float = 0.0, offset_m: tuple[float, float] = (0.0, 0.0), seed: int = 4
) -> Scan:
    """Return a scan of particles that are turned about the origin, then moved; with noise, jumping lines and a tilt."""
    x, y = region.pixels_m((PX, PX))
    x, y = x - offset_m[0], y - offset_m[1]
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    surface = surface_from({"kind": "particles"})
    height = surface.relief(cos * x + sin * y, cos * y - sin * x, region.size_m[0] / PX, seed).height_m
    random = np.random.default_rng(noise)
    lines = np.cumsum(random.normal(0.0, 1e-10, PX))[:, None]
    return Scan(region, "Height", "m", height + lines + random.normal(0.0, 1e-10, (PX, PX)) + 2e-3 * x, 1)


def true_m(xy_m: tuple[float, float], turn_rad: float = TURN_RAD) -> tuple[float, float]:
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    return (cos * xy_m[0] - sin * xy_m[1] + OFFSET_M[0], sin * xy_m[0] + cos * xy_m[1] + OFFSET_M[1])


def record(folder: Path, *scans: Scan, keys: tuple[str, ...] = ()) -> Path:
    folder.mkdir()
    night, store = Night(), RecordStore(folder, ABOUT)
    for number, scan in enumerate(scans, 1):
        taken = Scan(scan.region, scan.channel, scan.unit, scan.values, night.now_ns, f"s{number}.nc")
        for key in keys[number - 1 : number]:
            store.take([start(night, key)])
        scanning, free = night.state(ScopeState.SCANNING), night.state(ScopeState.FREE)
        store.take([scanning, night.packet(taken, "Scan2d_Height"), free])
    store.close()
    return folder


@pytest.fixture(scope="module")
def remount() -> Remount:
    return find(scanned(FRAME, 1), scanned(TODAY, 2, turn_rad=TURN_RAD, offset_m=OFFSET_M))


def test_turned_and_moved_sample_is_found_within_its_uncertainty(remount: Remount) -> None:
    assert remount.found
    assert remount.angle_rad == pytest.approx(TURN_RAD, abs=3 * remount.angle_sd_rad)
    assert math.dist(remount.center_now_m, true_m(remount.center_m)) < 3 * remount.sd_m
    assert remount.sd_m < 0.2 * FRAME.size_m[0] / PX
    assert remount.angle_sd_rad < math.radians(0.3)
    assert remount.wrong < 0.05


def test_places_of_the_earlier_night_get_coordinates_of_today(remount: Remount) -> None:
    region = Region((9e-7, -9e-7), (2e-7, 1e-7), 0.5)
    now = remount.region_now(region)
    assert math.dist(now.center_m, true_m(region.center_m)) < 3 * remount.now_sd_m(region.center_m)
    assert now.size_m == region.size_m
    assert math.remainder(now.angle_rad - 0.5 - TURN_RAD, math.tau) == pytest.approx(0.0, abs=3 * remount.angle_sd_rad)


def test_uncertainty_grows_with_the_distance_from_the_common_area(remount: Remount) -> None:
    far = (remount.center_m[0] + 1e-4, remount.center_m[1])
    assert remount.now_sd_m(remount.center_m) == pytest.approx(remount.sd_m)
    assert remount.now_sd_m(far) == pytest.approx(math.hypot(remount.sd_m, 1e-4 * remount.angle_sd_rad))


def test_another_sample_is_not_found() -> None:
    found = find(scanned(FRAME, 1), scanned(TODAY, 2, seed=77), math.radians(40.0))
    assert not found.found
    assert found.reason


def test_turn_beyond_the_given_limit_is_not_found() -> None:
    found = find(scanned(FRAME, 1), scanned(TODAY, 2, turn_rad=TURN_RAD, offset_m=OFFSET_M), math.radians(20.0))
    assert not found.found


@pytest.mark.parametrize("within_rad", [0.0, 4.0, math.nan])
def test_meaningless_limit_is_refused(within_rad: float) -> None:
    with pytest.raises(InvalidValue, match="at most 180°"):
        find(scanned(FRAME, 1), scanned(FRAME, 2), within_rad)


def test_overview_is_the_largest_whole_scan(tmp_path: Path) -> None:
    small = Region((0.0, 0.0), (1e-6, 1e-6))
    with open_run(record(tmp_path / "run", scanned(small, 1), scanned(FRAME, 2), scanned(small, 3))) as run:
        assert overview_of(run)[0].number == 2
        assert overview_of(run, 3)[0].number == 3


def test_run_without_a_scan_is_refused(tmp_path: Path) -> None:
    with open_run(record(tmp_path / "run")) as run, pytest.raises(InvalidValue, match="no whole scan"):
        overview_of(run)


def test_command_prints_offset_and_angle_or_that_it_is_not_found(tmp_path: Path) -> None:
    night = record(tmp_path / "night", scanned(FRAME, 1))
    today = record(tmp_path / "today", scanned(TODAY, 2, turn_rad=SLIGHT_RAD, offset_m=OFFSET_M))
    other = record(tmp_path / "other", scanned(TODAY, 3, seed=77))

    found = CliRunner().invoke(app, ["find", str(today), str(night), *WITHIN])
    assert found.exit_code == 0, found.output
    assert "scan 1 of today in scan 1 of night" in found.output
    assert (seen := re.search(r"found SIMULATED: turned by (\S+)° ± (\S+)°", found.output)), found.output
    assert float(seen[1]) == pytest.approx(math.degrees(SLIGHT_RAD), abs=3 * float(seen[2]))

    facts = json.loads(CliRunner().invoke(app, ["find", str(today), str(night), *WITHIN, "--json"]).output)
    assert facts["angle_rad"] == pytest.approx(SLIGHT_RAD, abs=0.01)

    lost = CliRunner().invoke(app, ["find", str(other), str(night), *WITHIN])
    assert lost.exit_code == 1
    assert lost.output.startswith("not found: ")


def test_command_prints_the_keyed_regions_in_coordinates_of_today(tmp_path: Path) -> None:
    zoom = Region((9e-7, -9e-7), (2e-7, 1e-7), math.radians(20.0))
    night = record(tmp_path / "night", scanned(FRAME, 1), scanned(zoom, 3), keys=("wide", "zoom-1"))
    today = record(tmp_path / "today", scanned(TODAY, 2, turn_rad=SLIGHT_RAD, offset_m=OFFSET_M))
    found = CliRunner().invoke(app, ["find", str(today), str(night), *WITHIN])
    assert found.exit_code == 0, found.output
    (line,) = (line for line in found.output.splitlines() if "zoom-1" in line)
    number = r"(-?[\d.]+)"
    cells = re.search(rf"zoom-1 +\(900, -900\) nm +\({number}, {number}\) (µm|nm) .* 200 x 100 nm +{number}°", line)
    assert cells, line
    unit_m = {"µm": 1e-6, "nm": 1e-9}[cells[3]]
    assert math.dist((float(cells[1]) * unit_m, float(cells[2]) * unit_m), true_m(zoom.center_m, SLIGHT_RAD)) < 30e-9
    assert float(cells[4]) == pytest.approx(20.0 + math.degrees(SLIGHT_RAD), abs=0.5)


def test_compare_registers_scans_and_writes_its_page(tmp_path: Path) -> None:
    moved = Region((FRAME.center_m[0] + 6e-8, FRAME.center_m[1]), FRAME.size_m)
    runs = [record(tmp_path / "monday", scanned(FRAME, 1)), record(tmp_path / "tuesday", scanned(moved, 2))]
    page = tmp_path / "compare.html"
    done = CliRunner().invoke(app, ["compare", *map(str, runs), "-o", str(page)], env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.output
    assert "monday" in done.output
    assert "roughness of scan 1" in done.output
    assert "registered: the second scan was moved by" in page.read_text(encoding="utf-8")
    assert "not compared: the settings" in done.output
