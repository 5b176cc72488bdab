"""Faults of Nanosurf Studio: each is named in the log, nothing hangs, and the translator reconnects."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.plugins.nanosurf.nanosurf_bench import Bench
from tests.plugins.vendor_bench import SOON, Peer, ready, scanned, scans, small, states

from afspm.model import ControlResponse, ScopeState, names

Make = Callable[..., Bench]
FREE, UNDEFINED = ScopeState.FREE, ScopeState.UNDEFINED


def scans_again(peer: Peer) -> None:
    response = peer.act(names.START_SCAN)
    assert response.ok, response.reason
    assert scans(peer.until(FREE))


@pytest.mark.parametrize(
    ("kind", "logged"),
    [
        ("no-reply", "no answer to"),
        ("late-reply", "no answer to"),
        ("half-reply", "the connection was closed after"),
        ("garbage", "a reply that is not Lua"),
        ("error", "Studio's session is not what it was: an emulated error"),
    ],
)
def test_bad_reply_is_logged_and_studio_reconnected(bench: Make, kind: str, logged: str) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike(kind, duration_s=500.0)
    peer.until(UNDEFINED)
    peer.until(FREE)
    made.until_logged(logged)
    scans_again(peer)


def test_value_that_is_no_number_is_logged_and_scans_go_on(bench: Make) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike("nan")
    made.until_logged("Studio replied")
    while not (response := peer.act(names.START_SCAN)).ok:  # the frame itself may have been no number
        assert response.code in (ControlResponse.NOT_FREE, ControlResponse.NO_RESPONSE), response.reason
    while not scans(peer.until(FREE)):
        pass


@pytest.mark.parametrize(("kind", "logged"), [("dialog", "a dialog may wait on its screen"), ("restart", "connection")])
def test_studio_is_reconnected_when_it_answers(bench: Make, kind: str, logged: str) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike(kind, duration_s=600.0)
    peer.until(UNDEFINED)
    made.until_logged(logged)
    peer.until(FREE)
    scans_again(peer)


@pytest.mark.parametrize("kind", ["stopped", "withdrawn"])
def test_scan_stopped_at_the_panel_is_not_published(bench: Make, kind: str) -> None:
    made = bench(speed=20.0)
    peer = small(made, result_timeout_s=2.0)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike(kind)
    received = peer.until(FREE)
    assert not scans(received)
    assert states(received)[-1] == "FREE"


@pytest.mark.parametrize("kind", ["late-file", "half-file"])
def test_late_file_is_awaited(bench: Make, kind: str) -> None:
    made = bench()
    peer = small(made, result_timeout_s=100.0)
    made.strike(kind, duration_s=20.0)
    scanned(peer)


def test_scan_without_a_file_ends(bench: Make) -> None:
    made = bench()
    peer = small(made, result_timeout_s=20.0)
    made.strike("no-file")
    assert peer.act(names.START_SCAN).ok
    assert not scans(peer.until(FREE))
    scans_again(peer)


def test_lines_of_a_stopped_scan_are_not_published_as_a_scan(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.at_panel(lambda emulator: emulator.program.put("data.storage.save_partial_measurements", True))  # type: ignore[attr-defined]
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("stopped")
    assert not scans(peer.until(FREE))


def test_restarted_studio_is_reconnected(bench: Make) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike("crash")
    peer.until(UNDEFINED)
    made.start_controller_again()
    ready(peer)
    scans_again(peer)


def test_failed_force_curve_is_reported(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("spectrum-refused")
    assert peer.act(names.START_SPEC).ok
    assert states(peer.until(FREE))[-1] == "FREE"
    scans_again(peer)
