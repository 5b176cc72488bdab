"""Ports of Nanonis that fall silent: another one is taken, and the tip can still be withdrawn (results Z2)."""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from deadlines import DEADLINE_S
from tests.plugins.nanonis.nanonis_bench import Bench, Emulated
from tests.plugins.vendor_bench import PATIENT, SOON, Peer, scanned, small

from afspm.driver import ControllerLost
from afspm.emulation import ClientConnection
from afspm.model import ControlResponse, Scan, ScopeState, Spectrum, names
from afspm.plugins.nanonis.emulator import DelayedReply
from afspm.plugins.nanonis.session import WithdrawalPort

Make = Callable[..., Bench]
FREE, UNDEFINED = ScopeState.FREE, ScopeState.UNDEFINED
REAL: dict[str, Any] = {"speed": 1.0, "ports": 4, "one_each": True, "wedges": True, "port": 0}


def named(made: Bench, count: int) -> dict[str, Any]:
    """Return settings that name the first ports of the emulated controller."""
    host, _, ports = made.address.rpartition(":")
    return {"address": f"{host}:{','.join(ports.split(',')[:count])}", **SOON}


def holds(made: Bench, condition: Callable[[Emulated], object]) -> bool:
    """Wait until a condition holds in the emulator; return whether it did in time."""
    until_s, found = time.monotonic() + DEADLINE_S, list[bool]()
    while not (found and found[-1]) and time.monotonic() < until_s:
        made.at_panel(lambda emulator: found.append(bool(condition(emulator))))
    return found[-1]


def holds_now(made: Bench, condition: Callable[[Emulated], object]) -> bool:
    found = list[bool]()
    made.at_panel(lambda emulator: found.append(bool(condition(emulator))))
    return found[0]


def answers_late(emulated: Emulated) -> bool:
    return any(isinstance(one.waits_for, DelayedReply) for one in emulated._server.connections)


def wedged(emulated: Emulated) -> int:
    return emulated.wedged_ports


def is_withdrawn(emulated: Emulated) -> bool:
    return not emulated.rig.engaged


def withdraws_within(made: Bench, peer: Peer) -> float:
    """Ask for a withdrawal; return the real seconds until the tip leaves the sample."""
    asked_s = time.monotonic()
    response = peer.act(names.RETRACT)
    assert response.ok, response.reason
    assert holds(made, is_withdrawn)
    return time.monotonic() - asked_s


def test_kill_in_mid_answer_wedges_a_port_and_the_next_translator_takes_another(bench: Make) -> None:
    made = bench(**REAL)
    small(made, **named(made, 4))
    made.strike("slow", duration_s=2.0)
    assert holds(made, answers_late)
    made.kill()
    assert holds(made, wedged)
    peer = made.start(**named(made, 4))
    peer.until(FREE)
    made.until_logged("may be wedged until Nanonis is restarted")
    assert peer.act(names.START_SCAN).ok
    peer.until(lambda one: isinstance(one, Scan))
    assert withdraws_within(made, peer) < DEADLINE_S


def test_tip_is_withdrawn_by_the_third_port_while_the_others_stay_silent(bench: Make) -> None:
    made = bench(**REAL)
    peer = small(made, **named(made, 3))
    made.strike("wedged", count=2)
    peer.until(UNDEFINED)
    assert holds(made, lambda emulated: wedged(emulated) == 2)
    assert withdraws_within(made, peer) < DEADLINE_S
    made.until_logged("the tip was withdrawn over the connection kept for it")


def test_tip_is_withdrawn_while_a_question_to_the_silent_port_lasts(bench: Make) -> None:
    # the wait for that answer would be longer than this test
    made = bench(**REAL)
    peer = small(made, **{**named(made, 3), **PATIENT})
    made.strike("wedged")
    assert holds(made, wedged)
    assert withdraws_within(made, peer) < DEADLINE_S


def test_without_a_third_port_the_tip_stays(bench: Make) -> None:
    made = bench(**REAL)
    peer = small(made, **named(made, 2))
    made.strike("wedged", count=2)
    peer.until(UNDEFINED)
    assert holds(made, lambda emulated: wedged(emulated) == 2)
    assert peer.act(names.RETRACT).code == ControlResponse.NO_RESPONSE
    assert not holds_now(made, is_withdrawn)


def test_without_a_spare_port_scans_go_on_and_spectra_are_refused(bench: Make) -> None:
    made = bench(**REAL)
    peer = small(made, **named(made, 3))
    made.strike("wedged")
    peer.until(UNDEFINED)
    peer.until(FREE)
    made.until_logged("no port of Nanonis is left for a second connection")
    assert peer.act(names.START_SCAN).ok
    peer.until(lambda one: isinstance(one, Scan))
    assert "which a spectrum needs" in peer.act(names.START_SPEC).reason
    assert withdraws_within(made, peer) < DEADLINE_S


def test_end_of_the_process_waits_for_the_answer_in_flight(bench: Make) -> None:
    made = bench(**REAL)
    small(made, **named(made, 2))
    made.strike("slow", duration_s=1.0)
    assert holds(made, answers_late)
    made.let_go()
    assert holds(made, lambda emulated: not answers_late(emulated))
    assert not holds_now(made, wedged)


def test_port_for_withdrawing_is_held_open_and_asked_for_nothing_else(bench: Make) -> None:
    made = bench(**REAL)
    peer = small(made, **named(made, 3))
    assert scanned(peer)
    third = int(made.address.split(",")[2])
    asked = list[str]()
    made.at_panel(lambda emulated: asked.extend(emulated.asked[third]))
    assert asked == ["ZCtrl.OnOffGet"]


def test_translator_that_never_reached_the_working_ports_withdraws_the_tip(bench: Make) -> None:
    made = bench(**REAL)
    first = small(made, **named(made, 3))
    made.strike("wedged", count=2)
    first.until(UNDEFINED)
    assert holds(made, lambda emulated: wedged(emulated) == 2)
    made.kill()
    peer = made.start(**named(made, 3))
    peer.until(UNDEFINED)
    assert withdraws_within(made, peer) < DEADLINE_S


def test_dialog_costs_no_port(bench: Make) -> None:
    made = bench(**REAL)
    peer = small(made, **named(made, 2))
    made.strike("dialog", duration_s=9.0)
    peer.until(UNDEFINED)
    peer.until(FREE)
    assert peer.act(names.START_SPEC).ok
    peer.until(lambda one: isinstance(one, Spectrum))


def test_tip_is_withdrawn_by_a_program_that_stalls_for_some_seconds(bench: Make) -> None:
    made = bench(**REAL)
    peer = small(made, **{**named(made, 3), **PATIENT})
    made.strike("dialog", duration_s=4.0)
    assert withdraws_within(made, peer) < DEADLINE_S


def test_tip_is_withdrawn_although_a_stop_can_not_be_read(bench: Make) -> None:
    made = bench(**REAL, other_layout=["BiasSpectr.Stop"])
    peer = small(made, **named(made, 3))
    made.strike("wedged", count=2)
    peer.until(UNDEFINED)
    assert withdraws_within(made, peer) < DEADLINE_S


def second_port(made: Bench) -> int:
    return int(made.address.split(",")[1])


def at_second(made: Bench, do: Callable[[Emulated, ClientConnection], object]) -> None:
    def job(emulated: Emulated) -> None:
        port, there = second_port(made), emulated._server.connections
        do(emulated, next(one for one in there if one.socket.getsockname()[1] == port))

    made.at_panel(job)


@pytest.mark.parametrize("ports", [3, 4])
def test_port_that_another_program_holds_is_named_when_it_is_taken(bench: Make, ports: int) -> None:
    # makers N1
    made = bench(**REAL)
    with socket.create_connection(("127.0.0.1", second_port(made)), DEADLINE_S):
        peer = small(made, **named(made, ports))
        made.until_logged("another program may hold this port, or it may be wedged until Nanonis is restarted")
        made.until_logged(f"the next port is used in place of {second_port(made)}")
        response = peer.act(names.START_SPEC)
        assert response.ok == (ports > 3), response.reason
        if response.ok:
            peer.until(lambda one: isinstance(one, Spectrum))


def test_curve_whose_start_is_lost_is_given_up(bench: Make) -> None:
    # makers N1
    made = bench(**REAL)
    peer = small(made, **named(made, 3))
    at_second(made, lambda emulated, connection: emulated._server.wedge(connection))
    assert peer.act(names.START_SPEC).ok
    made.until_logged("BiasSpectr.Start has no answer, and for 10 s no curve has run")
    peer.until(ScopeState.INTERRUPTED)
    peer.until(FREE)
    assert "which a spectrum needs" in peer.act(names.START_SPEC).reason


def test_curve_whose_answer_is_lost_is_published_from_its_file(bench: Make) -> None:
    # makers N1
    made = bench(**REAL)
    peer = small(made, **named(made, 4))
    assert peer.act(names.START_SPEC).ok
    at_second(made, lambda _, connection: setattr(connection, "waits_for", DelayedReply(b"", 1e12)))
    made.until_logged("BiasSpectr.Start has no answer, and for 10 s no curve has run")
    peer.until(lambda one: isinstance(one, Spectrum))


# makers W1: a false ERROR after each short network loss
@pytest.mark.parametrize(("lasts_s", "is_error"), [(0.0, False), (15.0, False), (25.0, True)])
def test_short_loss_of_the_network_is_no_error_of_the_port_for_withdrawing(
    lasts_s: float, is_error: bool, caplog: pytest.LogCaptureFixture
) -> None:
    now_s, lost_until_s, links = 0.0, 0.0, list[Any]()

    def connected(timeout_s: float) -> Any:
        made_s = now_s

        def ask(name: str) -> None:
            if now_s < lost_until_s or made_s < lost_until_s <= now_s:
                raise ControllerLost("the network is down")

        links.append(SimpleNamespace(ask=ask, close=lambda: None))
        return links[-1]

    port = WithdrawalPort(connected, lambda: now_s, logging.getLogger("nanonis"))
    port.hold()
    now_s = 60.0  # the loss is found at the next question only, up to a minute late
    lost_until_s = now_s + lasts_s
    while now_s < 120.0:
        port.hold()
        now_s += 1.0
    assert ("no way is left" in caplog.text) is is_error
    assert len(links) > 1, "connected again"
