"""Reading scan files of the emulated controllers, 1024 x 1024 pixels and four channels, against `np.fromfile`.

Both read the same number of bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

import afspm
from afspm.plugins.asylum.emulator.files import igor_note, igor_wave
from afspm.plugins.gxsm.emulator import files as gxsm
from afspm.plugins.nanonis.emulator import files as nanonis
from benchmarks.effort import effort
from benchmarks.rows import Row, alternate, measurement

PIXELS = effort(1024, 32)
CHANNELS = ("Height", "Amplitude", "Deflection", "Phase")
TIMES = effort(9, 1)
AT_MOST_S = 0.15
TIMES_BARE = 50.0
"""Bare, nothing is made float64, turned or given a place; a quiet machine is assumed."""

Paths = list[Path]


def picture(channel: int) -> np.ndarray:
    """Return incompressible values, different for each channel."""
    return np.random.default_rng(channel).normal(size=(PIXELS, PIXELS)).astype(np.float32)


def igor(folder: Path) -> Paths:
    values = np.stack([picture(k).T for k in range(len(CHANNELS))], axis=2)
    note = igor_note({"XOffset": 0.0, "YOffset": 0.0, "ScanAngle": 0.0, "ScanDown": 0.0, "ScanRate": 1.0}.items())
    path = folder / "scan0001.ibw"
    path.write_bytes(igor_wave("scan0001", values, "m", [(1e-9, "m"), (1e-9, "m")], CHANNELS, note, 0.0))
    return [path]


def sxm(folder: Path) -> Paths:
    """Write each signal forward and backward: twice as much data as the others."""
    channels = [(k, name, "m", picture(k), picture(-k + 10)) for k, name in enumerate(CHANNELS)]
    path = folder / "scan001.sxm"
    scan = nanonis.SxmContent(
        path=str(path),
        start_s=0.0,
        duration_s=1024.0,
        center_m=(0.0, 0.0),
        range_m=(1e-6, 1e-6),
        angle_deg=0.0,
        upwards=False,
        line_s=(0.5, 0.5),
        bias_v=0.1,
        z_controller=("log Current", True, 1e-10, "A", 1e-12, 1e-9),
        comment="",
        channels=channels,
        settings={},
    )
    path.write_bytes(nanonis.sxm(scan))
    return [path]


def netcdf(folder: Path, write: Callable[[gxsm.GxsmScanFile], bytes]) -> Paths:
    """Write a file for each channel."""
    paths = []
    for k, name in enumerate(CHANNELS):
        paths.append(folder / f"scan001-Xp-{name}.nc")
        frame = (0.0, 0.0, 1e4, 1e4, 0.0)
        scan = gxsm.GxsmScanFile(str(paths[-1]), name, picture(k), 0.5, ("AA", "Å"), frame, 0.0, 1024.0, "SPM-SIM", 0.1)
        paths[-1].write_bytes(write(scan))
    return paths


WRITERS: dict[str, Callable[[Path], Paths]] = {
    ".ibw": igor,
    ".sxm, both directions": sxm,
    "four .nc of Gxsm3": lambda folder: netcdf(folder, gxsm.netcdf3),
    "four .nc of Gxsm4": lambda folder: netcdf(folder, gxsm.netcdf4),
}


def read_s(paths: Paths) -> float:
    began = perf_counter()
    read = [scan.values for path in paths for scan in afspm.read(path).scans]
    lasted_s = perf_counter() - began
    assert len(read) >= len(CHANNELS)
    assert all(values.shape == (PIXELS, PIXELS) for values in read)
    return lasted_s


def bare_s(paths: Paths) -> float:
    began = perf_counter()
    for path in paths:
        np.fromfile(path, np.float32)
    return perf_counter() - began


@measurement
def reading() -> Iterator[Row]:
    for name, write in WRITERS.items():
        with TemporaryDirectory() as folder:
            paths = write(Path(folder))
            read_s(paths)  # what is imported once is no part of it
            ours, bare = alternate(partial(read_s, paths), partial(bare_s, paths), TIMES)
            yield Row(f"read: {name}", "s", ours, None, AT_MOST_S)
            yield Row(f"read: {name}, and np.fromfile", "s", ours, bare, TIMES_BARE)
