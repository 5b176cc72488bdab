"""Files of real microscopes: their known facts are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC
from functools import cache
from itertools import pairwise

import igor2.binarywave
import numpy as np
import pytest
from benchmarks.data_folder import DATA
from scipy import io as scipy_io

import afspm
from afspm.model import Scan
from afspm.plugins.drift.estimators import estimator
from afspm.plugins.drift.registration import DriftScan
from afspm.storage.formats import FileContent


@cache
def real(name: str) -> FileContent:
    return afspm.read(DATA / name, zone=UTC)


def channels(content: FileContent) -> Mapping[str, Scan]:
    return {scan.channel: scan for scan in content.scans}


def alike(a: np.ndarray, b: np.ndarray) -> float:
    known = np.isfinite(a) & np.isfinite(b)
    return float(np.corrcoef(a[known], b[known])[0, 1])


def test_wave_of_asylum_agrees_with_another_reader() -> None:
    content = real("asylum/DTMicroscope_scan_0001.ibw")
    raw = igor2.binarywave.load(str(DATA / "asylum/DTMicroscope_scan_0001.ibw"))["wave"]["wData"]
    assert [scan.channel for scan in content.scans] == [
        "HeightRetrace", "Amplitude1Retrace", "Amplitude2Retrace", "Phase1Retrace", "Phase2Retrace", "FrequencyRetrace",
    ]  # fmt: skip
    for k, scan in enumerate(content.scans):
        np.testing.assert_array_equal(scan.values, raw[:, :, k].T)
    assert content.scans[0].region.center_m == (-2.5933e-06, -6.07e-06)
    np.testing.assert_allclose(content.scans[0].region.size_m, (5e-6, 5e-6))
    assert content.scans[0].time is not None
    assert content.scans[0].time.isoformat()[:19] == "2024-08-20T08:30:46"
    assert content.upwards is False


@pytest.mark.parametrize(("name", "points"), [("SiN_FD_plot", 2016), ("U3_3_p10004", 10097)])
def test_force_curves_of_asylum(name: str, points: int) -> None:
    content = real(f"asylum/fmt-igor-fd_{name}.ibw")
    (curve,) = content.spectra
    assert curve.names == ("Raw", "Defl", "ZSnsr", "Time")
    assert curve.values.shape == (points, 4)
    raw = igor2.binarywave.load(str(DATA / f"asylum/fmt-igor-fd_{name}.ibw"))["wave"]["wData"]
    np.testing.assert_array_equal(curve.values[:, :3], raw)
    assert content.header["StartHeadTemp"].endswith("°C")


def test_three_scans_of_asylum_follow_each_other_down_up_and_down() -> None:
    contents = [real(f"asylum/PZT_final000{k}.h5") for k in (1, 2, 3)]
    assert [content.upwards for content in contents] == [False, True, False]
    for before, after in pairwise(contents):
        assert after.start_ns == pytest.approx(before.end_ns, abs=2e9)


def seen(name: str, channel: str) -> DriftScan:
    scan = channels(real(f"asylum/{name}.h5"))[channel]
    return DriftScan(scan.values, scan.region, 0.0, 1.0)


@pytest.mark.parametrize("channel", ["AmplitudeRetrace", "DeflectionRetrace", "PhaseRetrace"])
def test_the_offset_of_asylum_is_the_centre_so_that_a_zoom_is_found_where_it_says(channel: str) -> None:
    whole, zoom = seen("PTO_Funakubo0004", channel), seen("PTO_Funakubo0005", channel)
    found = estimator("correlation").register(whole, zoom)
    assert found.accepted, found.reason
    assert np.abs(found.displacement_m).max() < 15e-9


PIXEL_M = 2e-6 / 255


@pytest.mark.parametrize("spec", [{"class": "brief", "transform": "affine"}, {"class": "correlation"}])
def test_the_drift_between_real_scans_is_found(spec: dict[str, str]) -> None:
    pair = seen("PMN28Pt0001", "DeflectionRetrace"), seen("PMN28Pt0002", "DeflectionRetrace")
    found = estimator(spec).register(*pair)
    assert found.accepted, found.reason
    np.testing.assert_allclose(found.displacement_m / PIXEL_M, (-5.2, 13.2), atol=1.0)


@pytest.mark.parametrize("kind", ["brief", "orb", "sift", "correlation"])
@pytest.mark.parametrize("channel", ["HeightRetrace", "DeflectionRetrace", "PhaseRetrace"])
def test_scans_of_different_samples_are_refused(kind: str, channel: str) -> None:
    first = seen("PZT_final0001", channel)
    for name in ("PMN28Pt0002", "PTO_Funakubo0005"):
        other = seen(name, channel)
        moved = replace(other, region=other.region.moved_to(first.region.center_m))
        assert not estimator(kind).register(first, moved).accepted


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("A151216.123306-02602", "Current"),
        ("Au_mica_2023_Y_A_diPAMY_195", "Current"),
        ("ProbeFlow_nanonis", "Z"),
    ],
)
def test_forward_and_backward_lines_of_nanonis_agree_as_they_are_and_not_mirrored(name: str, channel: str) -> None:
    scans = channels(real(f"nanonis/{name}.sxm"))
    forward, backward = scans[f"{channel} Forward"].values, scans[f"{channel} Backward"].values
    assert alike(forward, backward) > 0.85
    assert alike(forward, backward) > alike(forward, backward[:, ::-1]) + 0.1


def test_a_turned_scan_of_nanonis() -> None:
    content = real("nanonis/Au_mica_2023_Y_A_diPAMY_195.sxm")
    region = content.scans[0].region
    assert region.angle_rad == pytest.approx(-np.radians(135.1))
    assert region.center_m == (1.500662e-07, -1.571085e-07)
    assert region.size_m == pytest.approx((4e-9 * 255 / 256, 4e-9 * 255 / 256))
    assert content.start_ns is not None
    assert content.end_ns is not None
    assert (content.end_ns - content.start_ns) / 1e9 == pytest.approx(92.0)


@pytest.mark.parametrize(
    ("name", "kind", "shape"),
    [
        ("Bias-Spectroscopy002", "bias spectroscopy", (1024, 5)),
        ("Bias-Spectroscopy00015_20230420", "bias spectroscopy", (2048, 15)),
        ("nanonis_xarray_z", "Z spectroscopy", (200, 73)),
    ],
)
def test_spectra_of_nanonis(name: str, kind: str, shape: tuple[int, int]) -> None:
    (curve,) = real(f"nanonis/{name}.dat").spectra
    assert (curve.kind, curve.values.shape) == (kind, shape)
    assert len(set(curve.names)) == len(curve.names)
    assert set(curve.units) <= {"V", "A", "m", "K", "Hz", "deg"}
    assert np.isfinite(curve.values[:, 0]).all()
    assert (np.diff(curve.values[:, 0]) > 0).all() or (np.diff(curve.values[:, 0]) < 0).all()


def test_scans_of_both_versions_of_gxsm() -> None:
    third = real("gxsm/gxsm3/scan002-M-Xp-Topo.nc").scans[0]
    with scipy_io.netcdf_file(DATA / "gxsm/gxsm3/scan002-M-Xp-Topo.nc", mmap=False) as file:
        raw = file.variables["FloatField"].data[0, 0] * file.variables["dz"].getValue() * 1e-10
    np.testing.assert_allclose(third.values, raw[::-1], rtol=1e-6)
    assert (third.channel, third.unit) == ("Topo", "m")
    content = real("gxsm/gxsm4/scan002-M-Xp-ZSmTopo.nc")
    fourth = content.scans[0]
    assert (fourth.channel, fourth.unit, fourth.shape) == ("ZS-Topo", "m", (48, 64))
    np.testing.assert_allclose(fourth.region.center_m, (10e-9, -5e-9))
    np.testing.assert_allclose(fourth.region.size_m, (50e-9, 30e-9))
    assert fourth.region.angle_rad == pytest.approx(-np.radians(10.0))
    assert content.start_ns is not None
    assert content.end_ns is not None
    assert (content.end_ns - content.start_ns) == 4 * 10**9
    assert content.upwards is False


def test_a_scan_of_gxsm_that_was_stopped_has_the_rows_that_were_taken() -> None:
    values = real("gxsm/gxsm4/stopped001-M-Xp-ZSmTopo.nc").scans[0].values
    assert np.isfinite(values[-1]).all()
    assert np.isnan(values[:-1]).all()


def test_probe_data_of_gxsm() -> None:
    (curve,) = real("gxsm/gxsm4/scan006-VP001-VP.vpdata").spectra
    assert curve.names == ("Bias-mon", "Z-mon", "CurrentSim1", "CurrentSim2")
    assert curve.units == ("V", "m", "nA", "nA")
    assert curve.values.shape == (80, 4)
    assert curve["Bias-mon"][1] == pytest.approx(8525.738472510)
