"""`afspm drift FILE…`: the choice of scans, the output, and the files."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from record_lab import ABOUT, Night
from typer.testing import CliRunner

from afspm import read
from afspm.basics import InvalidValue
from afspm.cli.app import app
from afspm.driver import FileContent, FileFacts, encode_scan
from afspm.emulation import World
from afspm.model import Frame, Problem, Region, Scan, ScopeState
from afspm.plugins.drift.report.file_commands import tip_changed
from afspm.plugins.drift.track.record import DriftRecord
from afspm.plugins.drift.track.scan_series import series
from afspm.record.store import RecordStore

REGION = Region((0.0, 0.0), (1e-6, 1e-6))
PIXELS = 48
VELOCITY_M_S = (40e-12, -25e-12)


def content(*channels: str, end_s: float | None = 100.0, pixels: int = 8, name: str = "a.nc") -> FileContent:
    end_ns = None if end_s is None else int(end_s * 1e9)
    scans = tuple(Scan(REGION, channel, "m", np.zeros((pixels, pixels)), end_ns, name) for channel in channels)
    return FileContent("test", scans, start_ns=None if end_ns is None else end_ns - 10**11, end_ns=end_ns, upwards=True)


def test_scans_of_the_topography_are_in_order_of_time_with_times_and_directions_of_their_files() -> None:
    found = series([content("Phase", "Height", end_s=1000.0, name="b.nc"), content("Height", "Phase")])
    assert found.channel == "Height"
    assert [one.key for one in found.scans] == ["a.nc", "b.nc"]
    assert (found.scans[0].start_s, found.scans[0].end_s, found.scans[0].upwards) == (0.0, 100.0, True)


BROKEN_OFF = "e.nc: it was broken off: 3 of 8 lines are missing"


def test_unusable_files_are_reported_and_the_others_followed() -> None:
    others = [content("Height", end_s=None, name="c.nc"), content("Height", pixels=1, name="d.nc")]
    others.append(content("Height", name="e.nc"))
    others[-1].scans[0].values[5:] = np.nan
    found = series([content("Height"), *others, content("Height", end_s=900.0, name="b.nc")])
    assert [one.key for one in found.scans] == ["a.nc", "b.nc"]
    assert found.left_out == ("c.nc: it does not say when it was taken", "d.nc: 1 x 1 pixels", BROKEN_OFF)


def test_a_channel_without_two_scans_is_refused_with_the_existing_channels() -> None:
    with pytest.raises(InvalidValue, match=r"'Phase'.*in it: Height, Phase"):
        series([content("Height"), content("Phase")], "Phase")
    with pytest.raises(InvalidValue, match="no scan of a topography"):
        series([])


def test_refusal_names_the_reasons_why_scans_were_left_out() -> None:
    # users N3: "not 0 of 'Height' (in it: Height)", where the files had no time
    nowhere = replace(content("Height", name="b.mi"), stated_place="")
    with pytest.raises(InvalidValue) as refused:
        series([content("Height", end_s=None, name="a.mi"), nowhere])
    assert "a.mi: it does not say when it was taken; b.mi: it does not say where it was taken" in str(refused.value)


def test_places_in_the_words_of_files_are_compared_only_if_equal() -> None:
    # users N3: files by Gwyddion's converter, whose frames afspm does not know
    here, there = (f"xoffset {x} nm" for x in (0, 700))
    contents = [content("Height", end_s=100.0 * k, name=f"{k}.mi") for k in range(1, 5)]
    contents[:3] = [replace(one, stated_place=place) for one, place in zip(contents, (here, there, here), strict=False)]
    found = series(contents)
    assert [one.key for one in found.scans] == ["1.mi", "3.mi"]
    assert found.left_out == (
        f"2.mi: its place ({there}) can't be compared with others' ({here})",
        f"4.mi: its place (in m) can't be compared with others' ({here})",
    )


@pytest.mark.parametrize("correcting", [True, False])
def test_place_on_the_sample_is_mapped_to_the_place_under_the_tip(correcting: bool) -> None:
    """A file of the record, where the controller's own files are elsewhere."""
    drift_m = (30e-9, -20e-9)
    header = {"drift": {"matrix": [1.0, 0.0, -drift_m[0], 0.0, 1.0, -drift_m[1]], "correcting": correcting}}
    contents = []
    for k, known in enumerate((header, header, {})):
        one = content("Height", end_s=100.0 * (k + 1), name=f"{k}.h5")
        scans = tuple(replace(scan, region=replace(REGION, frame=Frame.SAMPLE)) for scan in one.scans)
        contents.append(replace(one, scans=scans, header=known))
    found = series(contents)
    expected = replace(REGION, center_m=drift_m) if correcting else REGION
    assert [scan.region for scan in found.scans] == [expected] * 2
    assert found.left_out == ("2.h5: it says where it is on the sample, but not where that was under the tip",)


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """Six scans of a drifting sample, as the simulated microscope saves them, and a broken file."""
    settings = {"surface": {"kind": "particles"}, "drift": {"velocity_m_per_s": (*VELOCITY_M_S, 0.0)}}
    world = World.from_settings(settings, seed=1, start_s=0.0)
    folder = tmp_path / "run"
    (folder / "scans").mkdir(parents=True)
    for k in range(6):
        scan = world.scan(REGION, (PIXELS, PIXELS), 1.0, 600.0 * k)
        measured = FileFacts(int(scan.end_s * 1e9), {"scan-speed [m/s]": 2e-6})
        (folder / "scans" / f"scan-{k}.nc").write_bytes(encode_scan(REGION, scan.channels(), measured))
    start = {"n": 1, "time_s": 0.0, "event": "start", "settings": settings, "seed": 1}
    (folder / "truth.jsonl").write_text(json.dumps(start) + "\n", encoding="utf-8")
    (folder / "scans" / "scan-6.nc").write_bytes(b"CDF\x02 half of a file")
    return folder


def test_a_run_folder_is_followed_printed_and_drawn(run_folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    line = ["drift", str(run_folder), "-o", str(output), "-j", "2", "--estimator", "correlation", "--tracker", "paper"]
    done = CliRunner().invoke(app, line, env={"COLUMNS": "100"})
    assert done.exit_code == 0, done.output
    assert "6 scans of Height" in done.output
    assert "scan-6.nc" in done.output, "what can't be read is named"
    record = DriftRecord.read(output / "drift.csv")
    assert record.matched.all()
    expected = np.array(VELOCITY_M_S) * (record.time_s - record.time_s[0])[:, None]
    np.testing.assert_allclose(record.drift_m, expected, atol=1e-6 / PIXELS)
    assert {"drift_estimates.csv", "drift_stack.nc"} <= {path.name for path in output.iterdir()}
    assert (output / "drift_errors.png").exists() == (find_spec("matplotlib") is not None)
    estimates = DriftRecord.read(output / "drift_estimates.csv")
    np.testing.assert_allclose(estimates.drift_m[1:], expected[1:], atol=1e-6 / PIXELS)


def test_scans_after_a_tip_change_of_the_run_are_marked(run_folder: Path) -> None:
    of_files = series([read(path) for path in sorted((run_folder / "scans").glob("scan-[0-5].nc"))]).scans
    scans = [replace(scan, key=f"of the controller/scan-{number:04d}.nc") for number, scan in enumerate(of_files)]
    assert tip_changed([run_folder], scans) == [""] * 6, "files alone do not show it"
    night, store = Night(), RecordStore(run_folder, ABOUT)
    for number in range(5):
        store.take([night.state(ScopeState.SCANNING), *night.scans(number, ("Height",)), night.state(ScopeState.FREE)])
        if number == 2:
            store.take([night.control("judge", (Problem.TIP_SHAPE_CHANGED,)), night.control("corrector")])
    store.close()
    assert tip_changed([run_folder], scans) == ["no", "no", "yes", "yes", "yes", ""]
    assert tip_changed([run_folder, run_folder], scans) == [""] * 6, "two runs have no common record"


def test_only_unreadable_files_end_with_an_error(tmp_path: Path) -> None:
    broken = tmp_path / "a.sxm"
    broken.write_bytes(b"nothing")
    done = CliRunner().invoke(app, ["drift", "--channel", "Z", str(broken), str(tmp_path / "missing.ibw")])
    assert done.exit_code != 0
    assert isinstance(done.exception, InvalidValue)
    assert "no file was read" in done.exception.what
    assert "a.sxm" in done.output
    assert "missing.ibw" in done.output
