"""What can go wrong at Nanosurf Studio: each has a name in the log, nothing hangs, and Studio is found again."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.plugins.nanosurf.nanosurf_bench import Bench
from tests.plugins.vendor_bench import SOON, Peer, ready, scanned, scans, small, states

from afspm.model import ScopeState, names

Make = Callable[..., Bench]
FREE, UNDEFINED = ScopeState.FREE, ScopeState.UNDEFINED


def scans_again(peer: Peer) -> None:
    response = peer.act(names.START_SCAN)
    assert response.ok, response.reason
    assert scans(peer.until(FREE))


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("no-reply", "no answer to"),
        ("late-reply", "no answer to"),
        ("half-reply", "the connection was closed after"),
        ("garbage", "a reply that is not Lua"),
        ("nan", "Studio replied"),
        ("error", "Studio's session is not what it was: an emulated error"),
    ],
)
def test_a_bad_reply_has_a_name_and_studio_is_found_again(bench: Make, kind: str, told: str) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike(kind, duration_s=500.0)
    peer.until(UNDEFINED)
    peer.until(FREE)
    made.until_said(told)
    scans_again(peer)


@pytest.mark.parametrize(("kind", "told"), [("dialog", "a dialog may wait on its screen"), ("restart", "connection")])
def test_studio_is_found_again_when_it_answers(bench: Make, kind: str, told: str) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike(kind, duration_s=600.0)
    peer.until(UNDEFINED)
    made.until_said(told)
    peer.until(FREE)
    scans_again(peer)


@pytest.mark.parametrize("kind", ["stopped", "withdrawn"])
def test_a_scan_that_ends_at_the_panel_gives_none(bench: Make, kind: str) -> None:
    made = bench(speed=20.0)
    peer = small(made, result_timeout_s=2.0)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike(kind)
    heard = peer.until(FREE)
    assert not scans(heard)
    assert states(heard)[-1] == "FREE"


@pytest.mark.parametrize("kind", ["late-file", "half-file"])
def test_a_file_that_comes_late_is_waited_for(bench: Make, kind: str) -> None:
    made = bench()
    peer = small(made, result_timeout_s=100.0)
    made.strike(kind, duration_s=20.0)
    scanned(peer)


def test_a_scan_without_a_file_ends_all_the_same(bench: Make) -> None:
    made = bench()
    peer = small(made, result_timeout_s=20.0)
    made.strike("no-file")
    assert peer.act(names.START_SCAN).ok
    assert not scans(peer.until(FREE))
    scans_again(peer)


def test_the_lines_that_a_broken_scan_has_are_no_scan(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.at_panel(lambda emulator: emulator.program.put("data.storage.save_partial_measurements", True))  # type: ignore[attr-defined]
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("stopped")
    assert not scans(peer.until(FREE))


def test_studio_that_crashes_is_lost_and_found(bench: Make) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike("crash")
    peer.until(UNDEFINED)
    made.start_controller_again()
    ready(peer)
    scans_again(peer)


def test_a_force_curve_that_fails_is_told(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("spectrum-refused")
    assert peer.act(names.START_SPEC).ok
    assert states(peer.until(FREE))[-1] == "FREE"
    scans_again(peer)
