"""Answers of other releases, and of a server that nobody here wrote: what can't be read costs no more than itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from tests.plugins.nanonis.nanonis_bench import Bench
from tests.plugins.vendor_bench import TURNED, Peer, ready, scanned, small, states

from afspm.model import ControlRequest, ControlResponse, Region, ScanParameters, ScopeState, Spectrum, names

Make = Callable[..., Bench]
FREE = ScopeState.FREE
_OWN = {"x-center": {"vendor": "PLL.CenterFreq 1", "unit": "Hz", "read_only": True, "watched": True}}
_SIDE = {
    "Piezo.DriftCompGet": "x-drift-rate-x",
    "ZCtrl.GainGet": names.ZCTRL_PGAIN,
    "Bias.Get": names.TIP_BIAS_VOLTAGE,
    "FolMe.SpeedGet": names.MOVE_SPEED,
    "BiasSpectr.PropsGet": names.SPEC_POINTS,
    "BiasSpectr.LimitsGet": names.SPEC_FROM,
    "LockIn.ModAmpGet": names.LOCK_IN_AMPLITUDE,
    "PLL.CenterFreqGet": "x-center",
}


def curve(peer: Peer) -> Spectrum:
    response = peer.act_once_free(names.START_SPEC)
    assert response.ok, response.reason
    (found,) = (one for one in peer.until(FREE) if isinstance(one, Spectrum))
    return found


def test_value_that_can_not_be_read_costs_itself_and_not_the_contact(bench: Make) -> None:
    # stmsim K2
    without_value = ("Util.VersionGet", "ZCtrl.CtrlListGet", "AutoApproach.Open", "ZCtrl.LimitsGet", "Current.Get")
    made = bench(other_layout=[*_SIDE, *without_value], release="2021")
    peer = small(made, parameters=_OWN)
    for name in _SIDE.values():
        for _ in range(2):
            refused = peer.get_response(name)
            assert refused.code == ControlResponse.PARAM_NOT_SUPPORTED, name
            assert "can't be read" in refused.reason
    assert peer.set(names.SPEC_POINTS, 32).ok is False
    assert scanned(peer)
    assert curve(peer)
    made.kill()
    log = made.log_text()
    assert "lost contact" not in log
    assert log.count("WARNING x-spec-points: not supported while Nanonis' answer can't be read") == 1


@pytest.mark.parametrize("kind", ["IV", "force"])
@pytest.mark.parametrize("reports", [[], ["curve-layout"]])
def test_settings_of_curves_are_read_in_both_layouts(bench: Make, kind: str, reports: list[str]) -> None:
    # stmsim K2
    made = bench(as_reported=reports)
    peer = small(made)
    assert peer.set(names.SPEC_KIND, kind).ok
    assert peer.set(names.SPEC_POINTS, 33).ok
    assert int(peer.get(names.SPEC_POINTS)) == 33
    assert len(curve(peer).values) == 33
    assert "lost contact" not in made.log_text()


def test_curves_are_taken_and_stopped_without_a_status(bench: Make) -> None:
    # stmsim K3
    made = bench(speed=20.0, as_reported=["curve-status"])
    peer = small(made)
    for _ in range(2):
        assert curve(peer)
    made.at_panel(
        lambda emulator: emulator.software.core.registers.put("BiasSpectr.Timing", *[0.0] * 4, 9.0, *[0.0] * 3)
    )
    assert peer.act_once_free(names.START_SPEC).ok
    assert peer.act(names.STOP_SPEC).ok
    assert states(peer.until(FREE))[-2:] == ["INTERRUPTED", "FREE"]
    assert made.emulator.software.spectra.running is None
    assert made.log_text().count("BiasSpectr.StatusGet is not asked from now on") == 1


def test_curve_is_refused_while_its_height_can_not_be_read(bench: Make) -> None:
    peer = small(bench(other_layout=["BiasSpectr.TimingGet"]))
    assert peer.get_response(names.SPEC_Z_OFFSET).code == ControlResponse.PARAM_NOT_SUPPORTED
    assert "height of curves can't be read" in peer.act(names.START_SPEC).reason


def test_narrower_frame_keeps_the_speed_at_a_controller_that_keeps_the_time_a_line(bench: Make) -> None:
    # stmsim K4
    peer = small(bench(as_reported=["keeps-time"]))
    for side_m in (100e-9, 80e-9):
        region = Region((0.0, 0.0), (side_m, side_m), 0.0)
        answer = peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(region, (8, 16), ""))
        assert answer.ok, answer.reason
        assert float(peer.get(names.SCAN_SPEED)) == pytest.approx(2e-6)


@pytest.mark.parametrize("autosave", [True, False])
def test_curve_without_saving_is_saved_or_fetched_at_once(bench: Make, *, autosave: bool) -> None:
    # stmsim K5
    made = bench(as_reported=["unsaved-curves"])
    peer = small(made, autosave=autosave, result_timeout_s=1e6)  # the wait for a file is longer than this test
    found = curve(peer)
    assert found.filename.endswith(".dat" if autosave else ".nc")
    assert "no complete file" not in made.log_text()


def test_sweep_of_z_that_counts_towards_the_sample_is_refused(bench: Make) -> None:
    # stmsim K9
    peer = small(bench(as_reported=["z-sweep-towards"]))
    assert peer.set(names.SPEC_Z_FROM, 1e-9).ok
    assert "the controller set 2.2e-09 m instead of -2e-10 m" in peer.set(names.SPEC_Z_TO, -0.2e-9).reason


def test_way_back_in_the_order_of_time_is_mirrored(bench: Make) -> None:
    # stmsim K10: only a sample that is alike both ways tells
    made = bench(as_reported=["backward-by-time", "unsaved-curves"])
    found = curve(small(made, autosave=False))
    there, back = (found.values[:, found.names.index(name)] for name in ("Current", "Current [bwd]"))
    assert np.corrcoef(there, back[::-1])[0, 1] > 0.9


def test_angle_of_a_counter_clockwise_controller_turns_the_frame_the_other_way(bench: Make) -> None:
    # stmsim K11
    made = bench(as_reported=["counter-clockwise"])
    peer = made.start()
    ready(peer)
    assert scanned(peer)
    turned: list[float] = []
    made.at_panel(lambda emulator: turned.append(emulator.rig.setup.region.angle_rad))
    assert turned == [pytest.approx(-TURNED.angle_rad)]
