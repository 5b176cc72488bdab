"""The figures of a drifting night, from the published mappings and the saved files."""

from __future__ import annotations

import errno
import json
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_lab import Lab, context_of, run

from afspm import wire
from afspm.basics import ExitCode, FileError
from afspm.components import line_file
from afspm.driver import FileFacts, encode_scan
from afspm.emulation import World
from afspm.model import Region
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.report.drift_pictures import DriftPictures, TabledScan, parts
from afspm.plugins.drift.report.simulated_truth import true_drift
from afspm.plugins.drift.track.record import DriftRecord

pytest.importorskip("matplotlib")
SETTINGS: dict[str, Any] = {"surface": {"kind": "particles"}, "drift": {"velocity_m_per_s": (60e-12, -30e-12, 0.0)}}
PIXELS, EVERY_S, SWITCHED_ON = 48, 600.0, 4


pytestmark = pytest.mark.usefixtures("coarse")


class Hurried(DriftPictures):
    """Compares nothing at the end."""

    compared_within_s = 0.0


class HurriedAndIdle(Hurried):
    """Repeats no comparison after a restart, as if the end came at once."""

    def on_tick(self) -> None:
        pass


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The runs of which figures would be drawn."""
    found: list[Any] = []
    monkeypatch.setattr("afspm.plugins.drift.report.album.write", lambda run, *_, **__: found.append(run) or [])
    return found


def test_the_scan_during_which_correction_was_switched_on_belongs_to_no_part() -> None:
    told = [TabledScan(str(k), k >= 3, 60.0 * k) for k in range(6)]
    assert parts(told) == [("off", 0, 3), ("on", 4, 6)]
    assert parts([TabledScan("0", True, 0.0), TabledScan("1", True, 60.0)]) == [("on", 0, 2)]
    assert parts([TabledScan("0", False, 0.0)]) == [("off", 0, 1)]
    assert parts([]) == []


@cache
def scanned(*, with_speed: bool = True) -> list[tuple[bytes, Region, float]]:
    """Return nine scans, from the fourth on in a frame that follows the sample: as saved, where, and when."""
    world = World.from_settings(SETTINGS, seed=1, start_s=0.0)
    found = []
    for k in range(9):
        middle_s = EVERY_S * k + PIXELS / 2
        x, y, _ = world.drift_m(middle_s) - world.drift_m(PIXELS / 2)
        region = Region((float(x), float(y)) if k >= SWITCHED_ON else (0.0, 0.0), (1e-6, 1e-6))
        scan = world.scan(region, (PIXELS, PIXELS), 1.0, EVERY_S * k)
        measured = FileFacts(int(scan.end_s * 1e9), {"scan-speed [m/s]": 2e-6} if with_speed else {})
        found.append((encode_scan(region, scan.channels(), measured), region, middle_s))
    return found


def saved(folder: Path, *, with_speed: bool = True) -> list[tuple[Path, Region, float]]:
    """The files of the scans, and their truth."""
    (folder / "scans").mkdir()
    found = []
    for k, (content, region, middle_s) in enumerate(scanned(with_speed=with_speed)):
        path = folder / "scans" / f"scan-{k}.nc"
        path.write_bytes(content)
        found.append((path, region, middle_s))
    start = {"n": 1, "time_s": 0.0, "event": "start", "settings": SETTINGS, "seed": 1}
    (folder / "truth.jsonl").write_text(json.dumps(start) + "\n", encoding="utf-8")
    return found


def mapping(path: Path, region: Region, middle_s: float, *, correcting: bool) -> object:
    """Return the mapping of a scheduler that follows the sample without error."""
    velocity = np.array(SETTINGS["drift"]["velocity_m_per_s"][:2])
    drift = velocity * (middle_s - PIXELS / 2)
    message: Any = wire.message_type("DriftMapping")(
        matrix=[1.0, 0.0, -drift[0], 0.0, 1.0, -drift[1]],
        covariance=[1e-18, 0.0, 0.0, 1e-18],
        rate=velocity,
        rate_covariance=[1e-30, 0.0, 0.0, 1e-30],
        matched=True,
        filename=str(path),
        center=region.center_m,
        correcting=correcting,
    )
    message.timestamp.FromNanoseconds(round(middle_s * 1e9))
    return message


def night(folder: Path, *, with_speed: bool = True) -> Lab:
    lab = Lab("drift_pictures")
    for k, one in enumerate(saved(folder, with_speed=with_speed)):
        told = mapping(*one, correcting=k >= SWITCHED_ON)
        lab.at(100.0 * (k + 1), partial(lab.publish, told, "DriftMapping"))
    return lab


def test_the_table_and_all_figures_are_there_when_the_experiment_has_ended(tmp_path: Path) -> None:
    lab = night(tmp_path)
    lab.at(1500.0, lab.kill)
    component = DriftPictures(estimator="correlation", features="correlation")
    assert run(component, lab, tmp_path / "state", run_dir=str(tmp_path), simulated=True) == ExitCode.ENDED
    assert len(DriftRecord.read(tmp_path / "drift_correction.csv")) == 9
    drawn = {path.stem for path in tmp_path.glob("*.png")}
    assert drawn == {
        "drift_offset", "drift_pairs", "drift_estimates_off", "drift_histogram_off", "drift_estimates_on",
        "drift_histogram_on", "drift_errors",
    }  # fmt: skip


def test_scans_are_drawn_at_their_middle_where_the_file_has_the_end_alone(tmp_path: Path, drawn: list[Any]) -> None:
    # paper F3: the matrix, Park and Nanosurf: the true drift was drawn half a scan beside its time
    lab = night(tmp_path, with_speed=False)
    lab.at(1500.0, lab.kill)
    run(DriftPictures("topography", "correlation"), lab, tmp_path / "state", run_dir=str(tmp_path), simulated=True)
    (shown,) = drawn
    assert [scan.mid_s for scan in shown.scans] == pytest.approx([middle_s for _, _, middle_s in scanned()])
    assert abs(shown.truth_m - shown.record.drift_m).max() < 1e-12


def test_a_restart_loses_nothing(tmp_path: Path) -> None:
    lab = night(tmp_path)
    lab.at(450.0, lab.parent_goes)
    first = DriftPictures(estimator="correlation", features="correlation")
    first.run_process(context_of(lab, tmp_path / "state", run_dir=str(tmp_path)))
    lab.restart_component()
    lab.at(1500.0, lab.kill)
    run(DriftPictures(estimator="correlation"), lab, tmp_path / "state", run_dir=str(tmp_path))
    record = DriftRecord.read(tmp_path / "drift_correction.csv")
    assert [Path(key).name for key in record.keys] == [f"scan-{k}.nc" for k in range(9)]
    assert (tmp_path / "drift_estimates_on.png").exists()
    assert not (tmp_path / "drift_errors.png").exists(), "the truth is for simulated microscopes"


def test_comparisons_before_a_restart_are_repeated_before_the_end(tmp_path: Path, drawn: list[Any]) -> None:
    lab = night(tmp_path)
    lab.at(850.0, lab.parent_goes)
    quick = {"estimator": "correlation", "features": "correlation"}
    DriftPictures(**quick).run_process(context_of(lab, tmp_path / "state", run_dir=str(tmp_path)))
    lab.restart_component()
    lab.at(1500.0, lab.kill)
    run(Hurried(**quick), lab, tmp_path / "state", run_dir=str(tmp_path))
    *_, shown = drawn
    assert len(shown.parts) == 2
    assert all(part.estimates is not None for part in shown.parts), "what was not compared before is left out"


def test_figures_without_comparisons_are_drawn_when_time_is_short(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lab = night(tmp_path)
    lab.at(850.0, lab.parent_goes)
    quick = {"estimator": "correlation", "features": "correlation"}
    DriftPictures(**quick).run_process(context_of(lab, tmp_path / "state", run_dir=str(tmp_path)))
    for path in tmp_path.glob("*.png"):
        path.unlink()
    lab.restart_component()
    lab.at(1500.0, lab.kill)
    run(HurriedAndIdle(**quick), lab, tmp_path / "state", run_dir=str(tmp_path))
    assert (tmp_path / "drift_pairs.png").exists()
    assert not (tmp_path / "drift_estimates_off.png").exists()
    (line,) = [record for record in caplog.records if "drift_estimates_off.png" in record.message]
    assert line.levelname == "WARNING"
    assert "3 of 3 comparisons" in line.message


def test_scans_of_a_night_are_never_all_in_memory(tmp_path: Path, drawn: list[Any]) -> None:
    lab = night(tmp_path)
    lab.at(1500.0, lab.kill)
    run(DriftPictures(estimator="correlation"), lab, tmp_path / "state", run_dir=str(tmp_path))
    (album,) = drawn
    assert len(album.scans) == 9
    assert album.scans[3] is not album.scans[3]
    assert [scan.key for scan in album.scans[2:4]] == [scan.key for scan in album.scans][2:4]


def test_unreadable_scans_are_left_out_and_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lab = night(tmp_path)
    for gone in (2, 7):
        (tmp_path / "scans" / f"scan-{gone}.nc").unlink()
    lab.at(1500.0, lab.kill)
    component = DriftPictures(estimator="correlation", features="correlation")
    assert run(component, lab, tmp_path / "state", run_dir=str(tmp_path)) == ExitCode.ENDED
    assert (tmp_path / "drift_estimates_on.png").exists()
    assert len([text for text in caplog.messages if "left out" in text]) == 1


def test_a_table_that_can_not_be_written_for_a_while_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = night(tmp_path)
    append, can_write = line_file._append, [False]

    def locked(path: Path, text: str) -> None:
        if not can_write[0]:
            raise PermissionError(errno.EACCES, "another program has it open", str(path))
        append(path, text)

    monkeypatch.setattr(line_file, "_append", locked)
    lab.at(450.0, lambda: can_write.__setitem__(0, True))
    lab.at(1500.0, lab.kill)
    component = DriftPictures(estimator="correlation", features="correlation")
    assert run(component, lab, tmp_path / "state", run_dir=str(tmp_path)) == ExitCode.ENDED
    assert len(DriftRecord.read(tmp_path / "drift_correction.csv")) == 9
    assert (tmp_path / "drift_estimates_on.png").exists()


def test_a_missing_channel_is_logged_at_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lab = night(tmp_path)
    lab.at(450.0, lambda: caplog.clear() if "'Z'" in caplog.text else pytest.fail("nothing was logged"))
    lab.at(1500.0, lab.kill)
    assert run(DriftPictures(channel="Z"), lab, tmp_path / "state", run_dir=str(tmp_path)) == ExitCode.ENDED
    assert "no pictures: only 0 of 9 scans can be read" in caplog.text


def true_m(folder: Path, *at: tuple[float, tuple[float, float]]) -> Any:
    """Return the true drift at times and places."""
    places = [(mid_s, Region(center_m, (1e-6, 1e-6))) for mid_s, center_m in at]
    return true_drift(folder, [DriftScan(np.zeros((4, 4)), region, mid_s, mid_s) for mid_s, region in places])


def test_the_truth_matches_the_simulated_world(tmp_path: Path) -> None:
    assert true_m(tmp_path, (0.0, (0.0, 0.0))) is None
    saved(tmp_path)
    a, b, c = (1e-6, 0.0), (0.0, 2e-6), (0.0, 0.0)
    np.testing.assert_allclose(true_m(tmp_path, (0.0, a), (100.0, b)), [(0.0, 0.0), (6e-9, -3e-9)], atol=1e-15)
    scan = {"start_s": 0.0, "end_s": 50.0, "compensated_start_m": [0.0, 0.0], "compensated_end_m": [2e-9, 1e-9]}
    with (tmp_path / "truth.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps({"n": 2, "time_s": 50.0, "event": "scan", "scan": scan}) + "\n")
    left = [(0.0, 0.0), (1.5e-9 - 1e-9, -0.75e-9 - 0.5e-9), (6e-9 - 2e-9, -3e-9 - 1e-9)]
    np.testing.assert_allclose(true_m(tmp_path, (0.0, a), (25.0, b), (100.0, c)), left, atol=1e-15)


def test_the_truth_of_a_rotating_sample_depends_on_the_place(tmp_path: Path) -> None:
    turning = {**SETTINGS, "drift": {"rotation_rad_per_s": 1e-5, "expansion_per_s": 2e-5, "about_m": (1e-6, 0.0)}}
    start = {"n": 1, "time_s": 0.0, "event": "start", "settings": turning, "seed": 1}
    (tmp_path / "truth.jsonl").write_text(json.dumps(start) + "\n", encoding="utf-8")
    feature_m = (1e-6 + 3e-6 * np.exp(4e-3) * np.cos(2e-3), 3e-6 * np.exp(4e-3) * np.sin(2e-3))
    moved_m = np.subtract(feature_m, (4e-6, 0.0))
    true = true_m(tmp_path, (100.0, (0.0, 0.0)), (300.0, feature_m), (300.0, (1e-6, 0.0)))
    np.testing.assert_allclose(true, [(0.0, 0.0), tuple(moved_m), (0.0, 0.0)], atol=1e-15)


def test_a_malformed_truth_is_refused(tmp_path: Path) -> None:
    (tmp_path / "truth.jsonl").write_text("{}\n", encoding="utf-8")
    with pytest.raises(FileError, match="what was simulated"):
        true_m(tmp_path, (0.0, (0.0, 0.0)))
