"""Packets for peers that process one message per poll."""

from __future__ import annotations

import math

from afspm.model import Packet, ScopeState
from afspm_published.version_1 import MOST_WAITING, PAUSE_S, Pacing


def put(pacing: Pacing, *messages: str | ScopeState) -> None:
    for one in messages:
        state = one if isinstance(one, ScopeState) else None
        message = "ScopeStateMsg" if isinstance(one, ScopeState) else one
        pacing.put(Packet(one.name if isinstance(one, ScopeState) else one, b"", 1), message, state)


def taken(pacing: Pacing, now_s: float) -> list[str]:
    return [packet.envelope for packet in pacing.take(now_s)]


def test_channels_of_a_scan_go_out_one_per_poll_and_the_state_after_them() -> None:
    pacing = Pacing()
    put(pacing, "Scan2d", "Scan2d", ScopeState.FREE)
    assert taken(pacing, 10.0) == ["Scan2d"]
    assert pacing.due_s == 10.0 + PAUSE_S
    assert taken(pacing, 10.0 + PAUSE_S / 2) == []
    assert taken(pacing, 10.0 + PAUSE_S) == ["Scan2d", "FREE"]
    assert pacing.due_s == math.inf


def test_a_passing_state_lasts_a_poll_after_the_last_settings() -> None:
    pacing = Pacing()
    put(pacing, ScopeState.MOVING)
    assert taken(pacing, 10.0) == ["MOVING"]
    put(pacing, "ScanParameters2d", ScopeState.FREE)
    assert taken(pacing, 10.3) == ["ScanParameters2d"]
    assert taken(pacing, 10.3 + PAUSE_S * 0.9) == []
    assert taken(pacing, 10.3 + PAUSE_S) == ["FREE"]


def test_an_interruption_lasts_a_poll_and_scanning_is_no_passing_state() -> None:
    pacing = Pacing()
    put(pacing, ScopeState.SCANNING, ScopeState.INTERRUPTED, ScopeState.FREE)
    assert taken(pacing, 10.0) == ["SCANNING", "INTERRUPTED"]
    assert taken(pacing, 10.0 + PAUSE_S) == ["FREE"]


def test_packets_held_for_a_late_joiner_keep_their_order() -> None:
    pacing = Pacing()
    pacing.hold(11.0)
    put(pacing, "ZCtrlParameters", "Scan2d")
    assert taken(pacing, 10.9) == []
    assert taken(pacing, 11.0) == ["ZCtrlParameters", "Scan2d"]


def test_packets_beyond_the_bound_go_out_at_once() -> None:
    pacing = Pacing()
    put(pacing, *(["Scan2d"] * (MOST_WAITING + 10)))
    assert len(taken(pacing, 10.0)) == 10
    assert len(pacing.take_all()) == MOST_WAITING
