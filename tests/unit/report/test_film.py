"""A film of scans of one place stands still, whichever way the drift was recorded."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from record_lab import ABOUT, Given, Night

import afspm
from afspm import wire
from afspm.basics.errors import FileError, InvalidValue
from afspm.model import Frame, Region, Scan, ScopeState
from afspm.night.run import Run
from afspm.record.store import RecordStore
from afspm.report.export import export
from afspm.report.film import FORMATS, Film, places, recorded_drift

SIDE_M = 1e-6
PIXELS = 64
STEP_M = (40e-9, -25e-9)  # of the sample from scan to scan
SCANS = 5


def ground(x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights of a sample with no symmetry, in its own coordinates."""
    u, v = x_m / SIDE_M, y_m / SIDE_M
    bumps = [(0.1, 0.2, 0.11), (-0.25, 0.05, 0.08), (0.22, -0.2, 0.09), (-0.1, -0.28, 0.06)]
    height = np.zeros_like(u)
    for a, b, w in bumps:
        height += math.e ** -((u - a) ** 2 / w**2 + (v - b) ** 2 / w**2)
    return 1e-9 * height


def scan_of(place: Region, moved_m: tuple[float, float], night: Night, number: int, channel: str = "Height") -> Scan:
    x, y = place.pixels_m((PIXELS, PIXELS))
    values = ground(x - moved_m[0], y - moved_m[1])
    return Scan(place, channel, "m", values, night.now_ns, f"scan-{number:04d}.nc")


def drifted(step: int) -> tuple[float, float]:
    return step * STEP_M[0], step * STEP_M[1]


def recorded(folder: Path, frame: Frame, *, with_drift: bool, corrected_from: int = 0) -> Run:
    """Return a run with the same tip region SCANS times, on a sample that moves below it.

    In sample coordinates, the scans from `corrected_from` on have their place on the sample.
    """
    folder.mkdir(exist_ok=True)
    night = Night()
    store = RecordStore(folder, replace(ABOUT, facts={**ABOUT.facts, "frame": frame.value}, frame=frame))
    for step in range(SCANS):
        moved = drifted(step)
        place = Region((0.0, 0.0), (SIDE_M, SIDE_M), 0.3)
        scan = scan_of(place, moved, night, step)
        is_corrected = frame is Frame.SAMPLE and step >= corrected_from
        if is_corrected:
            seen = Region((-moved[0], -moved[1]), place.size_m, place.angle_rad, Frame.SAMPLE)
            scan = replace(scan, region=seen)
        packets = [night.state(ScopeState.SCANNING), night.packet(scan, f"Scan2d_1000.0_{scan.channel}")]
        if with_drift:
            assert scan.time_ns is not None
            packets.append(drift_packet(night, scan.time_ns, moved, step, correcting=is_corrected))
        store.take([*packets, night.state(ScopeState.FREE)])
        night.now_ns += 300_000_000_000
    store.close()
    return afspm.open_run(folder)


def drift_packet(
    night: Night, time_ns: int, moved_m: tuple[float, float], step: int, *, correcting: bool = False
) -> Given:
    matrix = [1.0, 0.0, -moved_m[0], 0.0, 1.0, -moved_m[1]]
    message: Any = wire.message_type("DriftMapping")(
        matrix=matrix,
        center=[0.0, 0.0],
        covariance=[0.0] * 4,
        matched=True,
        filename=f"scan-{step:04d}.nc",
        correcting=correcting,
    )
    message.timestamp.FromNanoseconds(time_ns)
    return night.packet(message)


def jitter(film: Film) -> float:
    """Return the largest difference between frames, as a part of the span of values, away from the edges."""
    inner = film.frames[:, 20:-20, 20:-20]
    return float(np.nanmax(np.abs(inner - inner[0])) / (np.nanmax(inner) - np.nanmin(inner)))


@pytest.mark.parametrize(
    ("frame", "with_drift", "aligned_by"),
    [(Frame.SAMPLE, False, "sample coordinates"), (Frame.TIP, True, "recorded drift")],
)
def test_film_of_a_drifting_sample_stands_still(
    frame: Frame, with_drift: bool, aligned_by: str, tmp_path: Path
) -> None:
    film = recorded(tmp_path, frame, with_drift=with_drift).film()
    assert film.frames.shape == (SCANS, PIXELS, PIXELS)
    assert film.numbers == tuple(range(1, SCANS + 1))
    assert film.aligned_by == aligned_by
    assert jitter(film) < 0.08


def test_film_stands_still_if_correction_began_during_the_run(tmp_path: Path) -> None:
    film = recorded(tmp_path, Frame.SAMPLE, with_drift=True, corrected_from=2).film()
    assert film.numbers == tuple(range(1, SCANS + 1))
    assert jitter(film) < 0.08


def test_film_without_a_record_of_drift_shows_scans_as_they_were(tmp_path: Path) -> None:
    film = recorded(tmp_path, Frame.TIP, with_drift=False).film()
    assert film.aligned_by == ""
    assert jitter(film) > 0.3
    np.testing.assert_array_equal(film.drift_m, 0.0)


def test_part_of_the_window_that_a_scan_missed_is_unmeasured(tmp_path: Path) -> None:
    frames = recorded(tmp_path, Frame.SAMPLE, with_drift=False).film().frames
    assert np.isfinite(frames[0]).all()
    assert np.isnan(frames[-1]).any()
    assert np.isfinite(frames[-1]).mean() > 0.6


@pytest.mark.parametrize("suffix", FORMATS)
def test_film_is_written_and_read_by_others(suffix: str, tmp_path: Path) -> None:
    run = recorded(tmp_path / "run", Frame.SAMPLE, with_drift=False)
    path = run.film().save(tmp_path / f"film{suffix}", frames_per_s=4.0, width_px=320)
    count, size = READERS[suffix](path)
    assert count == SCANS
    assert size == (320, 320)
    assert [file.name for file in tmp_path.iterdir() if file.is_file()] == [path.name]


def _gif(path: Path) -> tuple[int, tuple[int, int]]:
    with Image.open(path) as image:
        return int(getattr(image, "n_frames", 1)), image.size


def _mp4(path: Path) -> tuple[int, tuple[int, int]]:
    import av

    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    return len(frames), (frames[0].width, frames[0].height)


READERS: dict[str, Callable[[Path], tuple[int, tuple[int, int]]]] = {".gif": _gif, ".mp4": _mp4}


def test_all_frames_have_one_contrast(tmp_path: Path) -> None:
    film = recorded(tmp_path, Frame.SAMPLE, with_drift=False).film()
    doubled = replace(film, frames=np.stack([film.frames[0], 2.0 * film.frames[0]]), numbers=(1, 2))
    dark, bright = (np.asarray(image, dtype=float) for image in doubled.images())
    assert dark[150:330, 150:330].max() < bright[150:330, 150:330].max()


def test_places_scanned_once_have_no_film(tmp_path: Path) -> None:
    night, store = Night(), RecordStore(tmp_path, ABOUT)
    for step in range(3):
        place = Region((3 * step * SIDE_M, 0.0), (SIDE_M, SIDE_M))
        scan = scan_of(place, (0.0, 0.0), night, step)
        store.take(
            [night.state(ScopeState.SCANNING), night.packet(scan, "Scan2d_1_Height"), night.state(ScopeState.FREE)]
        )
    store.close()
    run = afspm.open_run(tmp_path)
    assert places(run.scans, recorded_drift(run)) == []
    with pytest.raises(InvalidValue, match="needs two scans of one place"):
        run.film()
    with pytest.raises(InvalidValue, match="scans 1 and 2 are of different places"):
        run.film(list(run.scans)[:2])
    with pytest.raises(InvalidValue, match="needs two scans of one place"):
        list(export(run, "gif", tmp_path / "out"))


def test_film_refuses_other_channels_suffixes_and_rates(tmp_path: Path) -> None:
    run = recorded(tmp_path, Frame.SAMPLE, with_drift=False)
    with pytest.raises(InvalidValue, match="has no channel 'Phase'"):
        run.film(channel="Phase")
    with pytest.raises(InvalidValue, match=r"can't be written as '.avi'"):
        run.film().save(tmp_path / "film.avi")
    with pytest.raises(InvalidValue, match="0 frames a second"):
        run.film().save(tmp_path / "film.gif", frames_per_s=0.0)
    with pytest.raises(FileError, match="can't be written"):
        run.film().save(tmp_path / "missing" / "film.gif")


def test_export_writes_a_film_of_each_place(tmp_path: Path) -> None:
    run = recorded(tmp_path / "run", Frame.SAMPLE, with_drift=False)
    (path,) = export(run, "gif", tmp_path / "out")
    assert path.name == "film-01-Height.gif"
    assert _gif(path)[0] == SCANS
    (part,) = export(run, "gif", tmp_path / "part", "2-4")
    assert _gif(part)[0] == 3


def test_clock_of_a_film_is_in_utc_as_all_exports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not hasattr(time, "tzset"):
        pytest.skip("this system has one zone")
    film = recorded(tmp_path, Frame.TIP, with_drift=False).film()
    here = [np.asarray(image) for image in film.images()]
    monkeypatch.setenv("TZ", "XYZ-5:30")
    time.tzset()
    try:
        elsewhere = [np.asarray(image) for image in film.images()]
    finally:
        monkeypatch.undo()
        time.tzset()
    assert all(np.array_equal(one, other) for one, other in zip(here, elsewhere, strict=True))
