"""Channels by what they measure, from the driver's declaration to a component's choice."""

from __future__ import annotations

import numpy as np
import pytest
from makers import MAKERS

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError, NoSuchItem
from afspm.model import HEIGHT, TOPOGRAPHY, ChannelRoles, Region, Scan, ScanSet, both_ways
from afspm.simulation.feedback import MODES
from afspm.simulation.simulator import Simulator

ROLES = ChannelRoles.declared(
    both_ways({"height": ["Z", "Topo"], "current": ["I"], "other": ["Bias"]}, "{} Forward", "{} Backward")
)


def scan(channel: str, roles: ChannelRoles = ROLES) -> Scan:
    return roles.shown(Scan(Region((0.0, 0.0), (1e-6, 1e-6)), channel, "m", np.zeros((2, 2))))


def test_scan_is_of_its_name_and_of_its_role() -> None:
    assert scan("Topo Forward").is_of(HEIGHT)
    assert scan("Topo Forward").is_of("Topo Forward")
    assert scan("Z Backward").roles == ("height, retrace",)
    assert not scan("Z Backward").is_of(HEIGHT)
    assert scan("Bias Forward").roles == ()


def test_set_of_scans_finds_a_name_before_a_role() -> None:
    named = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "height", "m", np.ones((2, 2)))
    scans = ScanSet([scan("Z Forward"), named])
    assert scans["height"] is named
    assert ScanSet([scan("Z Forward")])["height"].channel == "Z Forward"
    assert "height" in ScanSet([scan("Z Forward")])
    with pytest.raises(NoSuchItem, match=r"no channel 'phase'; there are Z Forward \(height\)"):
        ScanSet([scan("Z Forward")])["phase"]


def test_current_shows_the_surface_at_constant_height() -> None:
    assert ROLES.with_topography(feedback_on=True).names[TOPOGRAPHY] == ("Z Forward", "Topo Forward")
    assert ROLES.with_topography(feedback_on=None).names[TOPOGRAPHY] == ("Z Forward", "Topo Forward")
    assert ROLES.with_topography(feedback_on=False).names[TOPOGRAPHY] == ("I Forward",)
    shifted = ChannelRoles({**ROLES.names, "frequency shift": ("df Forward",)})
    assert shifted.with_topography(feedback_on=False).names[TOPOGRAPHY] == ("df Forward",)


def test_topography_is_the_intensity_where_there_is_no_height() -> None:
    beam = ChannelRoles.declared({"intensity": ("HAADF",), "other": ("MAADF",)})
    assert beam.with_topography(feedback_on=None).names[TOPOGRAPHY] == ("HAADF",)
    assert beam.refuses(TOPOGRAPHY) == ""
    both = ChannelRoles({**ROLES.names, "intensity": ("Camera",)})
    assert both.with_topography(feedback_on=True).names[TOPOGRAPHY] == ROLES.names["height"]


def test_file_names_other_channels() -> None:
    changed = ROLES.changed({"height": "ZS-Topo", "other": ["Lock-in X"]})
    assert changed.names["height"] == ("ZS-Topo",)
    assert changed.refuses("Lock-in X") == changed.refuses("topography") == changed.refuses("current, retrace") == ""
    assert changed.refuses("Z Forward") == "the microscope has no channel 'Z Forward'"
    assert changed.refuses("phase") == "the microscope has no role 'phase'"


@pytest.mark.parametrize("given", [{"hight": "Z"}, {"topography": "Z"}, {"height": ""}, {"height": [5]}])
def test_wrong_role_or_name_is_refused(given: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        ROLES.changed(given)  # type: ignore[arg-type]


def test_topography_is_shown_first() -> None:
    roles = ROLES.with_topography(feedback_on=True)
    assert roles.topography_first(["I Forward", "Z Backward", "Z Forward"]) == ("Z Forward", "I Forward", "Z Backward")
    assert ChannelRoles().topography_first(["b", "a"]) == ("b", "a")


@pytest.mark.parametrize("maker", MAKERS)
def test_driver_declares_the_heights_that_its_controller_records(maker: str) -> None:
    driver = entry_points.load(entry_points.DRIVERS, MAKERS[maker].driver)
    roles = driver.declared_channels({})
    assert roles.of(MAKERS[maker].heights) == (HEIGHT,)
    assert not {"height, retrace", "current"} - roles.names.keys()


@pytest.mark.parametrize("mode", MODES)
def test_simulator_declares_the_channels_of_its_mode(mode: str) -> None:
    roles = Simulator.declared_channels({"feedback": {"mode": mode}})
    assert ("amplitude" in roles.names) == (mode == "amplitude")
    assert ("frequency shift" in roles.names) == (mode == "frequency-shift")
