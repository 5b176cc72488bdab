"""Runs beside each other: what differs in their settings, records and scans."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from record_lab import ABOUT, REGION, Night

from afspm.basics.errors import InvalidValue
from afspm.model import ControlRequest, ControlResponse, JournalEntries, JournalEntry, Region, Scan, ScopeState
from afspm.model.arrays import Array
from afspm.night.run import open_run
from afspm.record.run_json import EXPERIMENT_FILE, RUN_FILE
from afspm.record.store import RecordStore
from afspm.report.comparison import RunComparison, compare, differences, flat_settings, roughness, same_region
from afspm.report.comparison_page import html, roughness_rows, write

PX = 24
ELSEWHERE = Region((8e-6, -2e-6), REGION.size_m)


def unmoved(first: Array, region: Region, second: Array, other: Region) -> tuple[Array, str]:
    return second, "laid over"


def waves(amplitude_m: float, pixels: int = PX) -> Array:
    """Return a chessboard of `amplitude_m`, which no levelling changes, with a tilt that levelling removes."""
    y, x = np.mgrid[:pixels, :pixels]
    return np.asarray(np.where((x + y) % 2 == 0, amplitude_m, -amplitude_m) + 1e-9 * x + 3e-9 * y, dtype=np.float64)


def record(folder: Path, values: list[tuple[Region, Array]], settings: str = "", sample: str = "gold") -> Path:
    """Make a run with scans, a pulse, and a flagged problem."""
    folder.mkdir(parents=True)
    (folder / RUN_FILE).write_text(json.dumps({"name": folder.name, "metadata": {"sample": sample}}), encoding="utf-8")
    (folder / EXPERIMENT_FILE).write_text(settings, encoding="utf-8")
    night, store = Night(), RecordStore(folder, ABOUT)
    pulse = JournalEntry(
        night.now_ns, "request", "repair", "x-pulse", int(ControlResponse.SUCCESS), request=int(ControlRequest.ACTION)
    )
    store.take([night.control("series"), night.control("repair", (1,)), night.control("series")])
    for number, (region, height) in enumerate(values, 1):
        scan = Scan(region, "Height", "m", height, night.now_ns, f"scan-{number:04d}.nc")
        scanning, free = night.state(ScopeState.SCANNING), night.state(ScopeState.FREE)
        store.take([scanning, night.packet(scan, "Scan2d_Height"), free])
    store.take([night.packet(JournalEntries((pulse,)))])
    store.close()
    return folder


def compared(*folders: Path, **more: Any) -> RunComparison:
    with ExitStack() as stack:
        return compare([stack.enter_context(open_run(folder)) for folder in folders], unmoved, **more)


@pytest.fixture
def two(tmp_path: Path) -> RunComparison:
    speed = "[scheduler]\nclass = 'Scheduler'\n[series.limits]\nspeed = {}\n"
    record(tmp_path / "monday", [(REGION, waves(1e-9)), (ELSEWHERE, waves(1e-9))], speed.format("'1 um/s'"))
    nearly = replace(REGION, center_m=(REGION.center_m[0] + 2e-8, REGION.center_m[1]))
    record(tmp_path / "tuesday", [(nearly, waves(2e-9))], speed.format("'2 um/s'") + "[series.more]\nscans = 3\n")
    return compared(tmp_path / "monday", tmp_path / "tuesday")


def test_only_differing_settings_are_listed_with_absent_keys(two: RunComparison) -> None:
    assert two.settings == {"series.limits.speed": ['"1 um/s"', '"2 um/s"'], "series.more.scans": ["–", "3"]}


def test_numbers_and_texts_are_different_settings() -> None:
    found = differences([flat_settings({"a": {"b": "1"}}), flat_settings({"a": {"b": 1}})])
    assert found == {"a.b": ['"1"', "1"]}


def test_scans_problems_and_repairs_are_counted_beside_each_other(two: RunComparison) -> None:
    assert list(two.facts["scans"]) == ["2", "1"]
    assert list(two.facts["repairs"]) == ["1 × x-pulse"] * 2
    assert all(text.startswith("1 × ") for text in two.facts["problems"])
    assert list(two.facts["sample"]) == ["gold", "gold"]


def test_only_regions_of_both_runs_are_compared_with_their_roughness(two: RunComparison) -> None:
    (region,) = two.regions
    first, second = region.scans
    assert first is not None
    assert second is not None
    assert first.roughness is not None
    assert second.roughness is not None
    assert first.roughness.sq == pytest.approx(1e-9, rel=0.02)
    assert second.roughness.sq == pytest.approx(2e-9, rel=0.02)
    assert second.roughness.sa == pytest.approx(2e-9, rel=0.02)
    (row,) = roughness_rows(two)
    assert row == ["scan 1", "Sq 1 nm, Sa 1 nm (24 × 24)", "Sq 2 nm, Sa 2 nm (24 × 24)"]


def test_root_mean_square_and_mean_deviation_differ_for_a_spike() -> None:
    values = np.array([[0.0, 0.0], [np.nan, 3.0]])
    found = roughness(values)
    assert found is not None
    assert (found.sq, found.sa) == pytest.approx((2**0.5, 4 / 3))
    assert roughness(np.full((2, 2), np.nan)) is None


def test_difference_is_the_later_minus_the_first(two: RunComparison) -> None:
    (region,) = two.regions
    (change,) = region.differences.values()
    assert change.words == "laid over"
    assert change.values is not None
    assert np.abs(change.values).mean() == pytest.approx(1e-9, rel=0.05)


def test_scans_of_different_pixels_stand_side_by_side_without_difference(tmp_path: Path) -> None:
    folders = [record(tmp_path / str(n), [(REGION, waves(1e-9, n))]) for n in (PX, 2 * PX)]
    found = compared(*folders)
    (change,) = found.regions[0].differences.values()
    assert change.values is None
    assert change.words == "no difference: 24 × 24 and 48 × 48 pixels"
    assert change.words in html(found)


def test_same_key_is_the_same_region_wherever_it_lies(tmp_path: Path) -> None:
    with open_run(record(tmp_path / "a", [(REGION, waves(1e-9)), (ELSEWHERE, waves(1e-9))])) as run:
        here, there = run.scans
    assert not same_region(here, there)
    assert same_region(replace(here, key="tile"), replace(there, key="tile"))
    assert not same_region(replace(here, key="tile"), here)


def test_region_turned_or_of_another_size_is_another_region(tmp_path: Path) -> None:
    turned = replace(REGION, angle_rad=REGION.angle_rad + 0.05)
    larger = replace(REGION, size_m=(REGION.size_m[0] * 1.05, REGION.size_m[1]))
    places = [(region, waves(1e-9)) for region in (REGION, turned, larger)]
    with open_run(record(tmp_path / "a", places)) as run:
        first, *others = run.scans
    assert [same_region(first, other) for other in others] == [False, False]


def test_missing_file_of_a_scan_is_named_and_leaves_the_rest(tmp_path: Path) -> None:
    folders = [record(tmp_path / name, [(REGION, waves(1e-9)), (ELSEWHERE, waves(1e-9))]) for name in ("a", "b")]
    with open_run(folders[1]) as run:
        (folders[1] / run.scans[0].file).unlink()
    found = compared(*folders)
    assert [region.name for region in found.regions] == ["scan 2"]
    (reason,) = found.unread
    assert reason.startswith("scan 1 of b: ")
    assert "Not compared" in html(found)


def test_missing_experiment_file_is_named(tmp_path: Path) -> None:
    folders = [record(tmp_path / name, [(REGION, waves(1e-9))]) for name in ("a", "b")]
    (folders[0] / EXPERIMENT_FILE).unlink()
    (reason,) = compared(*folders).unread
    assert reason.startswith("the settings: ")


def test_regions_beyond_the_limit_are_counted(tmp_path: Path) -> None:
    places = [(Region((k * 5e-6, 0.0), (1e-6, 1e-6)), waves(1e-9)) for k in range(3)]
    found = compared(*(record(tmp_path / name, places) for name in ("a", "b")), most_regions=2)
    assert (len(found.regions), found.left_out) == (2, 1)
    assert "1 more" in html(found)


def test_one_run_or_the_same_run_twice_is_refused(tmp_path: Path) -> None:
    folder = record(tmp_path / "a", [(REGION, waves(1e-9))])
    with pytest.raises(InvalidValue, match="at least two"):
        compared(folder)
    with pytest.raises(InvalidValue, match="given twice"):
        compared(folder, folder)


def test_page_shows_one_contrast_flicker_and_simulated(two: RunComparison, tmp_path: Path) -> None:
    write(two, tmp_path / "compare.html")
    page = (tmp_path / "compare.html").read_text(encoding="utf-8")
    assert "SIMULATED" in page
    assert page.count('type="checkbox"') == 1
    assert "<script" not in page
    # both pictures, and both of the flicker, have the colour bar of the rougher scan; the difference has its own
    assert page.count("<span>2.01 nm</span>") + page.count("<span>2 nm</span>") == 4
