"""A z held without feedback at the emulated Nanonis: the order on the wire, and the way back after a kill."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.plugins.nanonis.nanonis_bench import Bench
from tests.plugins.vendor_bench import Peer, ready

from afspm.model import ControlResponse, ScopeState, ScopeStatus, names

Make = Callable[..., Bench]
STM = {
    "speed": 20.0,
    "feedback": {"mode": "current", "setpoint": 1e-10},
    "noise": {"white_m": 1e-12, "current_a": 1e-13},
}
SWITCHES = ("ZCtrl.OnOffSet", "ZCtrl.OnOffGet", "Bias.Set", "Bias.Get", "ZCtrl.ZPosSet", "ZCtrl.ZPosGet")


def hold(peer: Peer, offset_pm: float = -100.0) -> None:
    """Hold z at an offset, at a bias of 10 mV."""
    assert peer.act(names.HOLD_Z).ok
    assert peer.set(names.TIP_BIAS_VOLTAGE, 0.01, "V").ok
    assert peer.set(names.HELD_Z_OFFSET, offset_pm, "pm").ok
    peer.until(ScopeState.MOVING)
    peer.until(ScopeState.FREE)


def in_order(asked: list[str], *wanted: str) -> bool:
    """Return whether functions were asked for in this order, with others between them."""
    rest = iter(asked)
    return all(name in rest for name in wanted)


def test_z_is_held_and_set_back_in_order_on_the_wire(bench: Make) -> None:
    made = bench(**STM)
    peer = made.start()
    ready(peer)
    made.emulator.asked.clear()
    before_m = made.emulator.rig.z_m(made.clock.now_s())
    hold(peer)
    rig = made.emulator.rig
    there = [name for name in next(iter(made.emulator.asked.values())) if name in SWITCHES]
    assert in_order(there, "ZCtrl.OnOffSet", "ZCtrl.OnOffGet", "Bias.Set", "Bias.Get", "ZCtrl.ZPosSet", "ZCtrl.ZPosGet")
    assert there.index("ZCtrl.ZPosSet") > there.index("Bias.Set")
    assert there.count("ZCtrl.ZPosSet") >= 10, "a ramp takes steps of 10 pm"
    assert rig.setup.feedback.on is False
    assert rig.z_m(made.clock.now_s()) == pytest.approx(before_m - 100e-12, abs=3e-12)

    made.emulator.asked.clear()
    assert peer.act(names.RELEASE_Z).ok
    peer.until(ScopeState.FREE)
    back = [name for name in next(iter(made.emulator.asked.values())) if name in SWITCHES]
    acts = [name for name in back if name.endswith("Set")]
    assert acts == sorted(acts, key=["ZCtrl.ZPosSet", "Bias.Set", "ZCtrl.OnOffSet"].index)
    assert set(acts) == {"ZCtrl.ZPosSet", "Bias.Set", "ZCtrl.OnOffSet"}
    assert "Bias.Get" in back[back.index("Bias.Set") : back.index("ZCtrl.OnOffSet")], "read back before the feedback"
    assert "ZCtrl.OnOffGet" in back[back.index("ZCtrl.OnOffSet") :]
    assert (rig.setup.feedback.on, rig.setup.bias_v) == (True, pytest.approx(0.1))
    assert rig.ledger.crashes == 0


def test_translator_killed_in_a_hold_goes_the_way_back_before_anything_else(bench: Make) -> None:
    made = bench(**STM)
    ready(peer := made.start())
    hold(peer)
    made.kill()
    rig = made.emulator.rig
    assert rig.setup.feedback.on is False
    peer = made.start()
    received = peer.until(lambda one: one == ScopeStatus(ScopeState.MOVING))
    assert received
    peer.until(ScopeState.FREE)
    assert (rig.setup.feedback.on, rig.setup.bias_v) == (True, pytest.approx(0.1))
    assert rig.ledger.crashes == 0
    refused = peer.act(names.START_SCAN)
    assert refused.code == ControlResponse.ACTION_ERROR, "the one that held z must know that it is held no more"
    assert "z is held no more: the controller was lost, or the translator has ended in it" in refused.reason
    assert peer.act(names.RELEASE_Z).code == ControlResponse.ACTION_ERROR
    assert peer.act_once_free(names.START_SCAN).ok


def test_tip_is_withdrawn_if_z_can_not_be_read_on_the_way_back(bench: Make) -> None:
    made = bench(**STM)
    ready(peer := made.start())
    hold(peer)
    made.at_panel(lambda emulator: setattr(emulator.software.signals, "z_m", lambda now_s: 1e-9))
    assert peer.act(names.RELEASE_Z).ok
    made.until_logged("the way back from a held z failed: z was set to")
    peer.until(ScopeState.FREE)
    rig = made.emulator.rig
    assert not rig.engaged
    assert rig.setup.feedback.on is False
    assert rig.setup.bias_v == pytest.approx(0.1), "the rest is set back all the same"
    assert rig.ledger.crashes == 0
    refused = peer.act(names.RELEASE_Z)
    assert "as before it: tip-bias-voltage 0.1 V" in refused.reason


def test_bias_passes_zero_while_the_feedback_is_off_on_the_wire(bench: Make) -> None:
    made = bench(**STM)
    peer = made.start(bias_through_zero="hold")
    ready(peer)
    made.emulator.asked.clear()
    assert peer.set(names.TIP_BIAS_VOLTAGE, -0.5, "V").ok
    there = [name for name in next(iter(made.emulator.asked.values())) if name in SWITCHES]
    wanted = ("ZCtrl.OnOffSet", "ZCtrl.OnOffGet", "Bias.Set", "Bias.Get", "ZCtrl.OnOffSet", "ZCtrl.OnOffGet")
    assert in_order(there, *wanted)
    assert (there.count("ZCtrl.OnOffSet"), there.count("Bias.Set")) == (2, 1)
    rig = made.emulator.rig
    assert (rig.setup.feedback.on, rig.setup.bias_v, rig.ledger.crashes) == (True, pytest.approx(-0.5), 0)
    assert peer.act_once_free(names.START_SCAN).ok
