"""Variables of curves by their roles: names, units, order and sign differ by maker, what is measured does not."""

from __future__ import annotations

import numpy as np
import pytest

from afspm.basics import ConfigError, NoSuchItem
from afspm.model import Spectrum
from afspm.model.caption import stated_settings
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
    return roles.shown(Spectrum(None, "force", names, units, values))


@pytest.mark.parametrize("maker", ["Simulator", "Nanonis", "Gxsm", "Park", "Nanosurf"])
def test_pull_off_is_the_same_on_each_maker(maker: str) -> None:  # spectra F0
    found = curve(maker)
    assert found.of("force, retrace").min() == pytest.approx(BACK_N.min())
    assert found.of("force").min() == pytest.approx(THERE_N.min())
    assert len(found.of("force")) == len(found.of("height")) == len(Z_M)
    lowest = found.of("height, retrace")[int(np.argmin(found.of("force, retrace")))]
    assert lowest == pytest.approx(Z_M[int(np.argmin(BACK_N))])


def test_height_of_asylum_is_turned_away_from_the_sample() -> None:
    extension = np.r_[Z_M[::-1], Z_M].max() - np.r_[Z_M[::-1], Z_M]
    values = np.stack([extension, np.r_[THERE_N[::-1], BACK_N] / 0.4, extension], axis=1)
    found = Asylum.channels_of({}).shown(Spectrum(None, "force", ("Raw", "Defl", "ZSnsr"), ("m",) * 3, values))
    assert np.all(np.diff(found.of("height")) < 0), "it approaches"
    assert np.all(np.diff(found.of("height, retrace")) > 0)
    assert found.of("deflection, retrace").min() == pytest.approx(BACK_N.min() / 0.4)


def deflection_of_asylum(unit: str, values: np.ndarray, **calibration: tuple[float, str]) -> Spectrum:
    extension = np.r_[Z_M[::-1], Z_M].max() - np.r_[Z_M[::-1], Z_M]
    stated = stated_settings({f"x-{name.replace('_', '-')}": one for name, one in calibration.items()})
    name = "Defl" if unit == "m" else "DeflV"
    columns = np.stack([extension, values], axis=1)
    curve = Spectrum(None, "force", ("ZSnsr", name), ("m", unit), columns, in_force=stated)
    return Asylum.channels_of({}).shown(curve)


def test_force_is_the_deflection_times_the_spring_constant() -> None:  # spectra F0
    deflection_m = np.r_[THERE_N[::-1], BACK_N] / 0.4
    found = deflection_of_asylum("m", deflection_m, spring_constant=(0.4, "N/m"))
    assert found.of("force, retrace") == pytest.approx(BACK_N)
    assert found.of("force") == pytest.approx(THERE_N[::-1])
    assert (found.si_unit_of("force, retrace"), found.has("force")) == ("N", True)
    volts = deflection_of_asylum("V", deflection_m / 60e-9, spring_constant=(0.4, "N/m"), sensitivity=(60e-9, "m/V"))
    assert volts.of("force, retrace") == pytest.approx(BACK_N)


@pytest.mark.parametrize(
    ("unit", "calibration", "lacks"),
    [
        ("m", {}, "x-spring-constant in N/m is not known"),
        ("m", {"spring_constant": (0.4, "")}, "x-spring-constant in N/m is not known"),
        ("V", {"spring_constant": (0.4, "N/m")}, "x-sensitivity in m/V is not known"),
        ("arb", {"spring_constant": (0.4, "N/m")}, "its deflection is in arb"),
    ],
)
def test_force_without_a_calibration_is_refused(
    unit: str, calibration: dict[str, tuple[float, str]], lacks: str
) -> None:
    found = deflection_of_asylum(unit, np.r_[THERE_N[::-1], BACK_N], **calibration)
    assert not found.has("force, retrace")
    assert found.si_unit_of("force, retrace") == ""
    with pytest.raises(NoSuchItem, match=f"no 'force, retrace', and .*{lacks}"):
        found.of("force, retrace")


def test_check_refuses_a_force_without_a_spring_constant() -> None:
    asylum = Asylum.channels_of({}).variables
    assert asylum is not None
    assert asylum.refuses("force, retrace") == ""
    unknown = VariableRoles.declared({"deflection": ["Defl"]})
    assert "no spring constant (x-spring-constant, in N/m) to derive it from" in unknown.refuses("force, retrace")
    assert unknown.refuses("force, retrace", read=["x-spring-constant"]) == ""
    assert "no deflection and no spring constant" in VariableRoles.declared({"bias": ["Bias"]}).refuses("force")
    assert asylum.refuses("bias") == "its curves have no bias"


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
        ([0, 1, np.nan, np.nan, np.nan], None),
        ([0, np.nan, 2, 3, 4, 3, 2, 1, 0], 5),
        ([0, 1, 2, 0.9, np.nan], 3),
    ],
)
def test_sweep_turns_where_both_ways_cover_its_range(swept: list[float], turn: int | None) -> None:
    assert turning_point(np.array(swept, dtype=float)) == turn


def test_sweep_is_found_behind_other_columns() -> None:
    noise = np.random.default_rng(3).normal(size=2 * len(Z_M))
    swept, force = np.r_[Z_M[::-1], Z_M], np.r_[THERE_N[::-1], BACK_N]
    values = np.stack([noise, swept, force], axis=1)
    found = Gxsm.channels_of({}).shown(Spectrum(None, "VP", ("Bias-mon", "Z-mon", "Force"), ("V", "m", "N"), values))
    assert found.of("force, retrace") == pytest.approx(BACK_N)
    assert found.swept_role == "height"


@pytest.mark.parametrize(
    "bias",
    [
        np.r_[0:1:20j, 1:-1:40j, -1:0:20j],  # three ways
        np.random.default_rng(1).normal(size=50),
        np.zeros(50),
    ],
)
def test_curve_whose_ways_are_not_clear_gives_no_values(bias: np.ndarray) -> None:
    unclear = Spectrum(None, "IV", ("Bias", "Current"), ("V", "A"), np.stack([bias, bias], axis=1))
    with pytest.raises(NoSuchItem, match="ways of the curve are not clear"):
        unclear.of("current")


def test_way_back_may_be_shorter_or_stored_in_the_direction_of_the_way_there() -> None:
    short = np.stack([np.r_[Z_M[::-1], Z_M[:20]], np.r_[THERE_N[::-1], BACK_N[:20]]], axis=1)
    assert Spectrum(None, "force", ("Z", "Force"), ("m", "N"), short).of("force, retrace") == pytest.approx(BACK_N[:20])
    again = np.stack([np.r_[Z_M, Z_M], np.r_[THERE_N, BACK_N]], axis=1)
    found = Spectrum(None, "force", ("Z", "Force"), ("m", "N"), again)
    assert found.of("force") == pytest.approx(THERE_N)
    assert found.of("height, retrace") == pytest.approx(Z_M)


@pytest.mark.parametrize(
    ("unit", "si", "factor"), [("nS", "S", 1e-9), ("S", "S", 1.0), ("arb", "arb", 1.0), ("", "", 1.0)]
)
def test_unit_that_is_not_converted_stays(unit: str, si: str, factor: float) -> None:
    found = Spectrum(None, "IV", ("Bias", "dI/dV"), ("mV", unit), np.stack([Z_M, Z_M], axis=1))
    assert (found.si_unit_of("conductance"), found.si_unit_of("bias")) == (si, "V")
    assert found.of("conductance") == pytest.approx(Z_M * factor)
