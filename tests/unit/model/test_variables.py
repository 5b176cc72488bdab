"""Variables of curves by their roles: names, units, order and sign differ by maker, what is measured does not."""

from __future__ import annotations

import numpy as np
import pytest

from afspm.basics import ConfigError, NoSuchItem
from afspm.model import Spectrum
from afspm.model.channels import ChannelRoles
from afspm.model.variables import VariableRoles, turning_point
from afspm.plugins.asylum import Asylum
from afspm.plugins.gxsm import Gxsm
from afspm.plugins.nanonis import Nanonis
from afspm.plugins.nanosurf import Nanosurf
from afspm.plugins.park import Park
from afspm.simulation.simulator import Simulator

Z_M = np.linspace(-5e-9, 100e-9, 64)
THERE_N = np.where(Z_M < 0, -1e-9 - Z_M, -1e-9 * (Z_M < 2e-9))
BACK_N = np.where(Z_M < 20e-9, THERE_N - 7e-9, 0.0)
OUTWARDS = {"Simulator": "Z", "Nanonis": "Z rel", "Gxsm": "Z-mon"}
"""Swept from the contact outwards, with the way back in a column of its own."""
RETRACE_OF = {"Simulator": "Force Retrace", "Nanonis": "Force [bwd]", "Gxsm": "Force Retrace"}
DRIVERS = {one.__name__: one for one in (Simulator, Nanonis, Gxsm, Park, Nanosurf, Asylum)}


def curve(maker: str) -> Spectrum:
    """Return one curve as a maker orders and names it."""
    if maker in OUTWARDS:
        names: tuple[str, ...] = (OUTWARDS[maker], "Force", RETRACE_OF[maker])
        units: tuple[str, ...] = ("m", "nN", "nN")
        values = np.stack([Z_M, THERE_N * 1e9, BACK_N * 1e9], axis=1)
    else:
        names, units = ("Z", "Force"), ("nm", "N")
        values = np.stack([np.r_[Z_M[::-1], Z_M] * 1e9, np.r_[THERE_N[::-1], BACK_N]], axis=1)
    roles = DRIVERS[maker].channels_of({})
    return roles.shown_curve(Spectrum(None, "force", names, units, values))


@pytest.mark.parametrize("maker", ["Simulator", "Nanonis", "Gxsm", "Park", "Nanosurf"])
def test_pull_off_is_the_same_on_each_maker(maker: str) -> None:  # spectra F0
    found = curve(maker)
    assert found.of("force, retrace").min() == pytest.approx(BACK_N.min())
    assert found.of("force").min() == pytest.approx(THERE_N.min())
    assert len(found.of("force")) == len(found.of("height")) == len(Z_M)
    lowest = found.of("height, retrace")[int(np.argmin(found.of("force, retrace")))]
    assert lowest == pytest.approx(Z_M[int(np.argmin(BACK_N))])


def test_height_of_asylum_is_turned_away_from_the_sample_and_has_no_force() -> None:
    extension = np.r_[Z_M[::-1], Z_M].max() - np.r_[Z_M[::-1], Z_M]
    values = np.stack([extension, np.r_[THERE_N[::-1], BACK_N] / 0.4, extension], axis=1)
    found = Asylum.channels_of({}).shown_curve(Spectrum(None, "force", ("Raw", "Defl", "ZSnsr"), ("m",) * 3, values))
    assert np.all(np.diff(found.of("height")) < 0), "it approaches"
    assert np.all(np.diff(found.of("height, retrace")) > 0)
    assert found.of("deflection, retrace").min() == pytest.approx(BACK_N.min() / 0.4)
    with pytest.raises(NoSuchItem, match="no 'force'"):
        found.of("force")


def test_way_back_is_never_replaced_by_the_way_there() -> None:
    one_way = Spectrum(None, "force", ("Z", "Force"), ("m", "N"), np.stack([Z_M, THERE_N], axis=1))
    assert not one_way.has("force, retrace")
    with pytest.raises(NoSuchItem, match=r"no 'force, retrace'.*height, force \(Z, Force\)"):
        one_way.of("force, retrace")


def test_experiment_file_adds_a_name() -> None:
    roles = Nanonis.channels_of({"channels": {"force, retrace": "My Force [bwd]"}}).variables
    assert roles is not None
    assert roles.column("force, retrace", ("Z rel", "My Force [bwd]")) == "My Force [bwd]"
    assert roles.column("force, retrace", ("Z rel", "Force [bwd]")) == "Force [bwd]"
    with pytest.raises(ConfigError, match="no role 'sideways'"):
        ChannelRoles().changed({"sideways": "X"})
    with pytest.raises(ConfigError, match="no role 'sideways'"):
        VariableRoles.declared({"sideways": ("X",)})


@pytest.mark.parametrize(
    ("swept", "turn"),
    [
        ([0, 1, 2, 3, 4], None),
        ([4, 3, 2, 1, 0], None),
        ([0, 1, 2, 1, 0], 3),
        ([2, 1, 0, 0, 1, 2], 3),
        ([0, 1, 2, 3, 2.9, 3.1], None),  # noise at the end of one way
        ([1, 1, 1, 1], None),
        ([0, 1, np.nan, np.nan, np.nan], None),
        ([0, 1, 2, 0.9, np.nan], 3),
    ],
)
def test_sweep_turns_where_both_ways_cover_its_range(swept: list[float], turn: int | None) -> None:
    assert turning_point(np.array(swept, dtype=float)) == turn
