"""The variables of real curves by their roles, and the quantities that they show."""

from __future__ import annotations

from datetime import UTC

import numpy as np
import pytest
from benchmarks.data_folder import DATA

import afspm
from afspm.basics import InvalidValue
from afspm.model import Spectrum
from afspm.plugins.adaptive.pull_off import pull_off
from afspm.plugins.adaptive.quantities import evaluation


def curve(name: str) -> Spectrum:
    (found,) = afspm.read(DATA / name, zone=UTC).spectra
    return found


@pytest.mark.parametrize(
    ("name", "roles"),
    [
        ("asylum/fmt-igor-fd_SiN_FD_plot.ibw", {"Defl": "deflection", "ZSnsr": "height", "Time": "time"}),
        ("asylum/fmt-igor-fd_U3_3_p10004.ibw", {"Defl": "deflection", "ZSnsr": "height", "Time": "time"}),
        ("nanonis/Bias-Spectroscopy00015_20230420.dat", {"Bias calc": "bias", "Current": "current"}),
        ("nanonis/Bias-Spectroscopy002.dat", {"Bias calc": "bias"}),  # the user's "Input 3" may be any current
        (
            "nanonis/nanonis_xarray_z.dat",
            {
                "Z rel": "height",
                "Current [AVG]": "current",
                "Current [AVG] [bwd]": "current, retrace",
                "Frequency Shift [AVG]": "frequency shift",
                "Frequency Shift [AVG] [bwd]": "frequency shift, retrace",
                "Amplitude [AVG]": "amplitude",
                "Amplitude [AVG] [bwd]": "amplitude, retrace",
            },
        ),
        (
            "gxsm/gxsm4/scan006-VP001-VP.vpdata",
            {"Bias-mon": "bias", "Z-mon": "height", "CurrentSim1": "current"},
        ),
    ],
)
def test_variables_of_a_real_curve_have_their_roles(name: str, roles: dict[str, str]) -> None:
    found = curve(name)
    assert {
        one: role for one, role in zip(found.names, found.roles.roles_of(found.names), strict=True) if role
    } == roles


@pytest.mark.parametrize(
    ("name", "force_n"),
    [("SiN_FD_plot", pytest.approx(12.75e-9, rel=0.01)), ("U3_3_p10004", pytest.approx(26.3e-9, rel=0.01))],
)
def test_adhesion_of_a_real_force_curve_is_below_its_baseline(name: str, force_n: float) -> None:
    found = curve(f"asylum/fmt-igor-fd_{name}.ibw")
    height, force = found.of("height, retrace"), found.of("force, retrace")
    assert height[0] < height[-1]  # away from the sample
    pull = pull_off(found)
    assert pull.force_n == force_n
    far = force[-len(force) // 4 :]
    assert pull.force_n == pytest.approx(float(np.median(far) - force.min()), rel=0.02)


def test_current_of_a_real_tip_falls_with_the_height() -> None:
    found = curve("nanonis/nanonis_xarray_z.dat")
    for way in ("", ", retrace"):
        height, current = found.of(f"height{way}"), np.abs(found.of(f"current{way}"))
        assert current[np.argmin(height)] > 2.0 * current[np.argmax(height)]


def test_real_bias_spectrum_without_a_gap_has_none() -> None:
    with pytest.raises(InvalidValue, match="no band edge"):
        evaluation("gap").of(curve("nanonis/Bias-Spectroscopy00015_20230420.dat"))
