"""The coarse motor and the approach of the emulated Nanonis: what is on the wire, and where the sample is."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.plugins.nanonis.nanonis_bench import Bench
from tests.plugins.vendor_bench import Peer, ready

from afspm.model import ControlResponse, ScopeState, names

Make = Callable[..., Bench]
STM = {"speed": 20.0, "feedback": {"mode": "current", "setpoint": 1e-10}}
RIGHT, AWAY, FAR = (f"Motor.StartMove {way} {steps} 0 1" for way, steps in ((0, 20), (4, 100), (4, 20_000)))
ACTIONS = {"x-right": {"command": RIGHT}, "x-away": {"command": AWAY}, "x-far": {"command": FAR}}


def asked(made: Bench) -> list[str]:
    return [name for names in made.emulator.asked.values() for name in names]


def started(bench: Make) -> tuple[Bench, Peer]:
    made = bench(**STM)
    peer = made.start(actions=ACTIONS)
    ready(peer)
    return made, peer


def test_no_motor_is_asked_to_move_at_the_sample(bench: Make) -> None:
    made, peer = started(bench)
    for action in ACTIONS:
        assert peer.act(action).code == ControlResponse.ACTION_ERROR
    assert not [name for name in asked(made) if name.startswith("Motor.")]


def test_sample_moves_and_the_tip_comes_back_by_an_approach(bench: Make) -> None:
    made, peer = started(bench)
    rig, clock = made.emulator.rig, made.clock
    there = rig.world.sample.under((0.0, 0.0), clock.now_s())
    assert peer.act(names.RETRACT).ok
    peer.until(ScopeState.FREE)
    for action in ("x-away", "x-right"):
        assert peer.act(action).ok
    away_m = rig.coarse_m
    assert away_m == pytest.approx(100 * 100e-9, rel=0.2)
    assert peer.act(names.APPROACH).ok
    peer.until(ScopeState.COARSE_MOTOR)
    assert not rig.engaged
    peer.until(ScopeState.FREE)
    assert rig.engaged
    assert asked(made).index("AutoApproach.OnOffSet") > asked(made).index("Motor.StartMove")
    here = rig.world.sample.under((0.0, 0.0), clock.now_s())
    assert abs(here[0] - there[0]) == pytest.approx(20 * 100e-9, rel=0.4)
    assert rig.ledger.crashes == 0


def test_piezo_does_not_reach_a_sample_that_the_motor_has_left(bench: Make) -> None:
    made, peer = started(bench)
    assert peer.act(names.RETRACT).ok
    peer.until(ScopeState.FREE)
    assert peer.act("x-far").ok
    assert peer.act(names.ENGAGE).ok
    assert not made.emulator.rig.engaged


def test_lateral_step_of_a_tip_that_its_piezo_alone_has_withdrawn_strikes_it(bench: Make) -> None:
    made, peer = started(bench)
    assert peer.act(names.RETRACT).ok
    peer.until(ScopeState.FREE)
    assert peer.act("x-right").ok, "the translator knows no retraction: the scheduler asks for it"
    assert made.emulator.rig.ledger.stage_moves == 1


def test_retract_stops_an_approach(bench: Make) -> None:
    made, peer = started(bench)
    assert peer.act(names.RETRACT).ok
    peer.until(ScopeState.FREE)
    assert peer.act("x-far").ok
    assert peer.act(names.APPROACH).ok
    peer.until(ScopeState.COARSE_MOTOR)
    assert peer.act(names.RETRACT).ok
    peer.until(ScopeState.FREE)
    assert not made.emulator.rig.engaged


def test_motor_is_waited_for(bench: Make) -> None:
    peer = bench(**STM).start(actions={"x-step": {"command": "Motor.StartMove 4 10 0 0"}})
    ready(peer)
    assert peer.act(names.RETRACT).ok
    peer.until(ScopeState.FREE)
    assert "does not show that its motor moves: write 1" in peer.act("x-step").reason
