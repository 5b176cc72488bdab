"""A map of a quantity with known truth, and the curves that show it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from afspm.basics.errors import ConfigError
from afspm.simulation import World
from afspm.simulation.instrument import SimulatedInstrument
from afspm.simulation.property_map import QUANTITIES, PropertyMap, PropertyMapSettings

QUIET = {
    "iv": {"noise_a": 0.0, "relative_noise": 0.0, "noise_density_a": 0.0},
    "force": {"noise_m": 0.0},
    "tip_changes": {"per_hour": 0.0},
}
PLACES = np.linspace(-1e-6, 1e-6, 81)
X_M, Y_M = np.meshgrid(PLACES, PLACES)


def world(seed: int = 3, **settings: Any) -> World:
    return World.from_settings({"surface": "steps", "property_map": settings, **QUIET}, seed, 0.0)


def values(seed: int = 3, **settings: Any) -> np.ndarray:
    return PropertyMap(PropertyMapSettings(**settings), seed).at(X_M, Y_M)


@pytest.mark.parametrize("kind", ["smooth", "spotty"])
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_map_stays_in_its_range_and_follows_its_seed(kind: str, quantity: str) -> None:
    first, usual = values(kind=kind, quantity=quantity), QUANTITIES[quantity]
    assert usual.low <= first.min() < first.max() <= usual.high
    assert np.ptp(first) > 0.6 * (usual.high - usual.low)
    assert (first == values(kind=kind, quantity=quantity)).all()
    assert np.abs(first - values(seed=4, kind=kind, quantity=quantity)).max() > 0.1 * (usual.high - usual.low)


def test_a_smooth_map_varies_everywhere_and_a_spotty_one_in_few_places() -> None:
    def quiet_share(kind: str) -> float:
        slopes = np.hypot(*np.gradient(values(kind=kind)))
        return float((slopes < 0.1 * np.quantile(slopes, 0.99)).mean())

    assert quiet_share("smooth") < 0.3
    assert quiet_share("spotty") > 0.5


def test_spot_exponent_steepens_the_edges_of_spots_and_keeps_their_half_width() -> None:
    def shares(exponent: float) -> np.ndarray:
        return values(kind="spotty", low=0.0, high=1.0, spacing_m=2e-6, size_m=400e-9, spot_exponent=exponent)

    soft, steep = shares(2.0), shares(8.0)
    highest = soft.max()
    assert steep.max() == pytest.approx(highest, rel=0.02)
    between = [int(((one > 0.1 * highest) & (one < 0.9 * highest)).sum()) for one in (soft, steep)]
    assert between[1] < 0.4 * between[0]
    assert (steep > highest / 2).sum() == pytest.approx((soft > highest / 2).sum(), rel=0.05)


@pytest.mark.parametrize("exponent", [1.9, 21.0])
def test_spot_exponent_outside_its_range_is_refused(exponent: float) -> None:
    with pytest.raises(ConfigError, match="is not between 2 and 20"):
        PropertyMapSettings(kind="spotty", spot_exponent=exponent)


def test_values_do_not_depend_on_the_positions_asked_together() -> None:
    for kind in ("smooth", "spotty"):
        found = PropertyMap(PropertyMapSettings(kind=kind), 3)
        alone = [float(found.at(x, y)) for x, y in zip(X_M[7, ::9], Y_M[7, ::9], strict=True)]
        assert found.at(X_M, Y_M)[7, ::9] == pytest.approx(alone, rel=1e-9)


def test_without_a_map_curves_stay_as_they_were() -> None:
    plain = World.from_settings({"surface": "steps", **QUIET}, 3, 0.0)
    off = world(kind="none", low=0.1, high=0.2)
    for kind in ("IV", "force"):
        assert (plain.spectrum(kind, (1e-7, 2e-8), 1.0)[2] == off.spectrum(kind, (1e-7, 2e-8), 1.0)[2]).all()
    assert off.property_truth((0.0, 0.0), 1.0) == {}


def test_the_gap_of_the_map_is_where_no_current_flows() -> None:
    found = world(kind="smooth", quantity="gap")
    for x_m in (-4e-7, 0.0, 3e-7):
        names, _, curve = found.spectrum("IV", (x_m, 0.0), 1.0)
        conductance = curve[:, names.index("dI/dV")]
        inside = curve[conductance < 0.3 * conductance.max(), 0]
        # the bands rise as a square root, so a third of the conductance is reached soon beyond the edge
        gap_ev = float(found.property_map.at(x_m, 0.0))
        assert gap_ev - 0.02 < np.ptp(inside) < gap_ev + 0.4


def test_the_adhesion_of_the_map_pulls_the_tip_off() -> None:
    found = world(kind="smooth", quantity="adhesion")
    pulls = []
    for x_m in (-4e-7, 0.0, 3e-7):
        names, _, curve = found.spectrum("force", (x_m, 0.0), 1.0)
        pulls.append(-curve[:, names.index("Force Retrace")].min() / float(found.property_map.at(x_m, 0.0)))
    assert pulls == pytest.approx([pulls[0]] * 3, rel=0.05)


def test_the_map_moves_with_the_sample() -> None:
    drifting = world(kind="smooth", quantity="gap")
    moved = World.from_settings(
        {"surface": "steps", "property_map": {"kind": "smooth"}, "drift": {"velocity_m_per_s": [1e-9, 0.0, 0.0]}},
        3, 0.0,
    )  # fmt: skip

    def true_value(of: World, position_m: tuple[float, float]) -> Any:
        return of.property_truth(position_m, 50.0)["property"]

    there, here = true_value(moved, (5e-8, 0.0)), true_value(drifting, (0.0, 0.0))
    assert there["value"] == pytest.approx(here["value"])
    assert there["sample_m"] == pytest.approx([0.0, 0.0], abs=1e-15)


def test_every_spectrum_has_its_true_value_in_the_truth() -> None:
    noted: list[tuple[str, Any]] = []
    settings = {"surface": "steps", "property_map": {"kind": "spotty", "quantity": "modulus"}}
    rig = SimulatedInstrument(settings, 5, 0.0, note=lambda _, event, facts: noted.append((event, facts)))
    rig.start_spectrum("force", 10.0)
    ((event, facts),) = [line for line in noted if line[0] != "conditions"]
    assert event == "spectrum starts"
    assert facts["property"]["quantity"] == "modulus"
    assert facts["property"]["value"] == pytest.approx(float(rig.world.property_map.at(*facts["property"]["sample_m"])))


@pytest.mark.parametrize(
    "wrong", [{"kind": "spots"}, {"quantity": "colour"}, {"low": 2.0, "high": 1.0}, {"size_m": 0.0}, {"low": -1.0}]
)
def test_an_impossible_map_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as refused:
        world(**wrong)
    assert "property_map" in str(refused.value.where)
