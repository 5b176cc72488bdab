"""Faults of an Asylum microscope: each is a named error, nothing hangs, and the translator reconnects."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from tests.plugins.asylum.asylum_bench import Bench, Emulated
from tests.plugins.vendor_bench import SOON, Peer, scans, small, states

from afspm.model import ControlRequest, ControlResponse, ProbePosition, Scan, ScopeState, Spectrum, names
from afspm.simulation.faults import Fault

Make = Callable[..., Bench]
FREE = ScopeState.FREE
UNDEFINED = ScopeState.UNDEFINED


def scans_again(peer: Peer) -> list[Scan]:
    """Scan once more, to show that the translator works."""
    response = peer.act(names.START_SCAN)
    assert response.ok, response.reason
    found = scans(peer.until(FREE))
    assert found
    return found


@pytest.mark.parametrize(
    ("kind", "logged"),
    [
        ("no-reply", "no reply to"),
        ("wrong-id", "no reply to"),
        ("late-reply", "no reply to"),
        ("garbage", "sent an unreadable reply"),
        ("frames", "sent a reply of 3 frames"),
        ("not-utf8", "no reply to"),
        ("nan", "Asylum has no value"),
        ("aborted", "the function was aborted (107"),
        ("unknown", "an error without a name (1"),
    ],
)
def test_bad_reply_is_logged_and_igor_reconnected(bench: Make, kind: str, logged: str) -> None:
    made = bench()
    peer = small(made, **SOON)
    # the first two nan are of the status, where they mean that a release has no such value; others cost watched rows
    made.strike(kind, count=10 if kind == "nan" else 1, duration_s=500.0)
    peer.until(UNDEFINED)
    peer.until(FREE)
    made.until_logged(logged)
    scans_again(peer)


@pytest.mark.parametrize(
    ("kind", "logged"),
    [
        ("dialog", "Igor does not answer while a dialog is open on its screen"),
        ("busy", "no reply to"),
        ("not-compiled", "Igor's procedures are not compiled (100"),
        ("restart", "nothing listens at this address"),
    ],
)
def test_lasting_fault_is_reported_until_it_ends(bench: Make, kind: str, logged: str) -> None:
    made = bench(speed=1.0)
    peer = small(made, **SOON)
    made.strike(kind, duration_s=8.0)
    peer.until(UNDEFINED)
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.NO_RESPONSE
    assert "the controller can't be reached" in response.reason
    peer.until(FREE)
    made.until_logged(logged)


def test_moving_tip_is_still_moving_after_a_reconnection(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = small(made, move_s=20.0)
    arrives_s = made.clock.now_s() + 20.0
    assert peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((400e-9, 0.0))).ok
    peer.until(ScopeState.MOVING)
    made.strike("unknown")
    received = peer.until(FREE)
    assert states(received) == ["UNDEFINED", "MOVING", "FREE"]
    assert made.clock.now_s() >= arrives_s


def test_restarted_igor_is_reconnected(bench: Make, tmp_path: Path) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike("crash")
    peer.until(UNDEFINED)
    again = Emulated(port=int(made.address.rpartition(":")[2]), surface="steps")
    with ExitStack() as stack:
        stack.enter_context(again.running(tmp_path / "again", made.clock))
        peer.until(FREE)
        assert peer.get("x-engaged") == "true"


def test_missing_procedures_are_named(bench: Make) -> None:
    made = bench(procedures="none")
    peer = made.start()
    peer.until(UNDEFINED)
    made.until_logged("there is no such function (101")
    made.until_logged("is afspm.ipf included in Igor's procedures")


def test_procedures_of_the_published_afspm_suffice_to_scan(bench: Make) -> None:
    made = bench(procedures="spots")
    peer = small(made)
    scans_again(peer)
    assert peer.get(names.FEEDBACK_ON) == peer.get("x-engaged") == "true"
    response = peer.set(names.FEEDBACK_ON, False)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "there is no such function (101" in response.reason


# --- scans and curves ---


def test_refused_force_curve_is_an_error(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("force-refused")
    response = peer.act(names.START_SPEC)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "did not begin the force curve that it was asked for" in response.reason
    assert peer.act(names.START_SPEC).ok
    assert any(isinstance(one, Spectrum) for one in peer.until(FREE))


def test_force_curve_without_status_function_is_refused(bench: Make) -> None:
    made = bench(has_status=False)
    peer = small(made)
    response = peer.act(names.START_SPEC)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "Igor lacks ARGetStatus" in response.reason
    scans_again(peer)


def test_scan_runs_once_even_if_its_start_resets_last_scan(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("keeps-scanning")
    assert {Path(scan.filename).name for scan in scans_again(peer)} == {"Image0000.ibw"}
    assert made.emulator.controller.values.get("LastScan") == 1


def test_saving_is_switched_on_if_off(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.at_panel(lambda emulator: emulator.controller.values.put("SaveImage", 0))
    scans_again(peer)
    made.until_logged("Asylum did not save its measurements (SaveImage)")


@pytest.mark.parametrize("kind", ["late-file", "half-file"])
def test_late_or_partial_file_is_awaited(bench: Make, kind: str) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.strike(kind, duration_s=6.0)
    assert {Path(scan.filename).name for scan in scans_again(peer)} == {"Image0000.ibw"}


@pytest.mark.parametrize(("kind", "lasts_s"), [("no-file", 1.0), ("half-file", 1e6), ("drive-gone", 20.0)])
def test_scan_without_a_complete_file_is_reported_and_not_confused_with_the_next(
    bench: Make, kind: str, lasts_s: float
) -> None:
    made = bench(speed=20.0)
    peer = small(made, result_timeout_s=5.0)
    made.strike(kind, duration_s=lasts_s)
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert not scans(received)
    made.until_logged("ended without a result")
    assert scans_again(peer)[0].values.shape == (8, 16)


def test_file_of_the_same_name_belongs_to_the_new_scan(bench: Make) -> None:
    made = bench()
    peer = small(made)
    first = scans_again(peer)
    made.strike("same-name")
    second = scans_again(peer)
    assert first[0].filename == second[0].filename
    assert first[0].time_ns != second[0].time_ns
    assert (first[0].values != second[0].values).any()


def test_file_of_another_name_is_found(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("other-name")
    assert {Path(scan.filename).name for scan in scans_again(peer)} == {"Panel0000.ibw"}


@pytest.mark.parametrize("partial", [False, True])
def test_scan_stopped_at_the_panel_is_interrupted(bench: Make, partial: bool) -> None:
    made = bench(speed=4.0, saves_partial=partial)
    peer = small(made, result_timeout_s=3.0)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("stopped")
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)


def test_scan_reported_by_one_source_counts(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.emulator.faults.demand(Fault("status-stuck", 0.0, 1, 20.0), made.clock.now_s())
    received = peer.until(ScopeState.SCANNING)
    assert states(received) == ["SCANNING"]
