"""Heights in files of real microscopes as samples of the simulated microscope."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.data_folder import DATA

from afspm.basics.errors import FileError
from afspm.simulation.surfaces.picture import read


@pytest.mark.parametrize(
    ("name", "width_m", "shape"),
    [
        ("nanonis/ProbeFlow_nanonis.sxm", None, (160, 160)),
        ("nanonis/A151216.123306-02602.sxm", 2e-9 * 127 / 128, (128, 128)),
        ("gxsm/gxsm3/scan002-M-Xp-Topo.nc", 40e-9, (30, 40)),
        ("gxsm/gxsm4/scan002-M-Xp-ZSmTopo.nc", 50e-9, (48, 64)),
        ("asylum/DTMicroscope_scan_0001.ibw", None, (256, 256)),
        ("asylum/PZT_final0001.h5", 2e-6, (256, 256)),
    ],
)
def test_files_of_real_microscopes_are_read(name: str, width_m: float | None, shape: tuple[int, int]) -> None:
    found = read(DATA / name)
    assert found.height_m.shape == shape
    assert found.size_m is not None
    assert 1e-9 < found.size_m[0] < 1e-4
    assert np.ptp(found.height_m) < 1e-5
    if width_m:
        assert found.size_m[0] == pytest.approx(width_m)


@pytest.mark.parametrize(
    ("name", "why"),
    [("asylum/fmt-igor-fd_SiN_FD_plot.ibw", "no heights"), ("gxsm/gxsm3/scan002-Xp-ADC1.nc", "no heights")],
)
def test_real_file_without_heights_is_refused(name: str, why: str) -> None:
    with pytest.raises(FileError, match=why):
        read(DATA / name)
