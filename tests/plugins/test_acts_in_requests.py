"""A person sets a value or moves the frame in the middle of a request of the run that sets it, at each panel."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from tests.plugins.acts_at_wire_moments import ASIDE_M, FRAME, MAKERS, PANELS, SHAPE, own_home
from tests.plugins.by_hand import acts
from tests.plugins.vendor_bench import Peer, VendorBench

from afspm.model import ActByHand, ControlRequest, PanelAct, Region, ScanParameters, ScopeState

_SETTERS: dict[str, tuple[Callable[[Any], Any], str, str, str]] = {
    # owner and name of the emulator's function that sets; what its arguments have for the value, and for the frame
    "nanonis": (lambda emulator: emulator.software.functions, "call", "Bias.Set", "Scan.FrameSet"),
    "gxsm": (lambda emulator: emulator.program.entries, "set", "dsp-fbs-bias", "OffsetX"),
    "asylum": (lambda emulator: emulator.controller, "put", "TipVoltage", "XOffset"),
    "park": (lambda emulator: emulator.program, "ask", "bias.tip", "scan.setScanGeometry"),
    "nanosurf": (lambda emulator: emulator.program, "put", "z_control.setpoint", "imaging.frame_center_offset_x"),
}
"""The person acts right after the emulator has carried out the setting of the run."""


@pytest.fixture(params=MAKERS)
def maker(request: pytest.FixtureRequest) -> str:
    for name, package in (("park", "quickjs"), ("nanosurf", "lupa")):
        if request.param == name:
            pytest.importorskip(package, reason=f"the emulated program needs it: pip install afspm[{name}]")
    return str(request.param)


def act_after(
    made: VendorBench[Any], monkeypatch: pytest.MonkeyPatch, maker: str, act: Callable[[Any], object], *, frame: bool
) -> None:
    owner_of, name, of_value, of_frame = _SETTERS[maker]
    owner, trigger, left = owner_of(made.emulator), of_frame if frame else of_value, [act]
    plain = getattr(owner, name)

    def setting(*given: Any, **how: Any) -> object:
        done = plain(*given, **how)
        # SmartScan is asked for a value by the same function
        if left and trigger in given and "get" not in given:
            left.pop()(made.emulator)
        return done

    monkeypatch.setattr(owner, name, setting)


def at_frame(peer: Peer, region: Region) -> list[Any]:
    """Set a frame, and return all packets until the tip is there."""
    response = peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(region, SHAPE, ""))
    assert response.ok, response.reason
    return peer.until(ScopeState.MOVING) + peer.until(ScopeState.FREE)


@contextmanager
def at_rest(maker: str, folder: Path) -> Iterator[tuple[VendorBench[Any], Peer]]:
    """Yield a maker's bench and its peer, with the tip at rest in `FRAME`."""
    with own_home(folder), ExitStack() as stack:
        made = import_module(f"tests.plugins.{maker}.{maker}_bench").Bench(folder, stack, 1.0, {})
        peer = made.start(**PANELS[maker].settings)
        peer.until(ScopeState.FREE)
        at_frame(peer, FRAME)
        yield made, peer


# results M5
def test_value_set_at_the_panel_in_a_request_is_an_act_and_no_refusal(
    maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = PANELS[maker]
    with at_rest(maker, tmp_path) as (made, peer):
        act_after(made, monkeypatch, maker, lambda emulator: panel.turn(emulator, panel.by_hand), frame=False)
        response = peer.set(panel.value, panel.values[0])
        assert response.ok, response.reason
        received = [one for _ in range(2) for one in peer.until(lambda one: isinstance(one, ActByHand))]
        changes = [change for one in received if isinstance(one, ActByHand) for change in one.changes]
        told = [(change.parameter, float(change.before), float(change.after)) for change in changes]
        wanted, by_hand = (pytest.approx(one) for one in (panel.values[0], panel.by_hand))
        assert told == [(panel.value, wanted, by_hand), (panel.value, by_hand, wanted)]
        shown: list[float] = []
        made.at_panel(lambda emulator: shown.append(panel.shown(emulator)))
        assert shown == [wanted]


# results M5
def test_frame_moved_at_the_panel_in_a_request_is_an_act_and_no_refusal(
    maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = PANELS[maker]
    with at_rest(maker, tmp_path) as (made, peer):
        act_after(made, monkeypatch, maker, panel.move_frame, frame=True)
        center = (FRAME.center_m[0] + 0.5 * ASIDE_M, FRAME.center_m[1] - 10e-9)
        received = at_frame(peer, Region(center, FRAME.size_m, 0.0))
        assert acts(received) == [PanelAct.VALUES, PanelAct.VALUES]
        (region,) = [one.region for one in received if isinstance(one, ScanParameters)]
        assert isinstance(region, Region)
        assert region.center_m == pytest.approx(center, abs=1e-12)
