"""A person at the panels of the makers: steps and expectations that their tests share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tests.plugins.vendor_bench import Peer, VendorBench, scans, small, states

from afspm.model import ActByHand, PanelAct, ScopeState, names


def acts(received: Sequence[Any]) -> list[PanelAct]:
    """Return the acts by hand in received packets."""
    return [one.act for one in received if isinstance(one, ActByHand)]


def until_act(peer: Peer) -> list[Any]:
    """Return all received packets up to the next act by hand."""
    return peer.until(lambda one: isinstance(one, ActByHand))


def require_spoiled_by(
    made: VendorBench[Any], peer: Peer, hand: Callable[[Any], object], end: Callable[[Any], object], act: PanelAct
) -> None:
    """Act in a running scan, which then ends with all its lines, and is not published."""
    made.at_panel(hand)
    received = until_act(peer)
    made.at_panel(end)
    received += peer.until(ScopeState.FREE)
    assert acts(received) == [act]
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)


def require_no_result_of_a_moved_frame(
    made: VendorBench[Any], peer: Peer, hand: Callable[[Any], object], end: Callable[[Any], object]
) -> None:
    """Change the frame of a running scan, which then ends with all its lines, and is not published."""
    made.at_panel(hand)
    made.at_panel(end)
    received = peer.until(ScopeState.FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)
    made.until_logged("its frame was changed at the panel while it ran")


def set_all(peer: Peer, values: Mapping[str, float]) -> None:
    for name, value in values.items():
        assert peer.set(name, value).ok, name


def act_all(peer: Peer, *actions: tuple[str, ScopeState]) -> None:
    """Ask for actions, each once the microscope is free, and wait for the state of each."""
    for action, state in actions:
        response = peer.act_once_free(action)
        assert response.ok, (action, response.reason)
        peer.until(state)


def act_all_to_their_end(peer: Peer, *actions: tuple[str, ScopeState]) -> list[Any]:
    """Ask for actions, each after the end of the one before; return the packets of the last."""
    received: list[Any] = []
    for action, state in actions:
        response = peer.act_once_free(action)
        assert response.ok, (action, response.reason)
        received = peer.until(state) + peer.until(ScopeState.FREE)
    return received


def slow_scan(made: VendorBench[Any], speed_m_s: float = 1e-10, **settings: Any) -> Peer:
    """Start a translator and a scan that takes longer than any test."""
    peer = small(made, **settings)
    assert peer.set(names.SCAN_SPEED, speed_m_s).ok
    response = peer.act_once_free(names.START_SCAN)
    assert response.ok, response.reason
    assert acts(peer.until(ScopeState.SCANNING)) == [], "the run's own settings"
    return peer
