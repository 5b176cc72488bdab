"""A shadow beside a person at each emulated controller: it tells what the person does, and sends questions alone."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast

import pytest
from tests.plugins.gxsm.gxsm_bench import Calls
from tests.plugins.nanosurf.test_nanosurf_at_panel import until
from tests.plugins.panel_table import PANELS, Panel
from tests.plugins.test_makers import MAKERS, Maker
from tests.plugins.vendor_bench import PATIENT, SOON, Peer, VendorBench, scans, states
from tests.plugins.wire_tap import lua_scripts, nanonis_names, tapped, zmtp_objects

from afspm.driver import contact
from afspm.emulation import ScanActivity
from afspm.model import ActByHand, ControlResponse, PanelAct, ScopeState, names

FREE, SCANNING = ScopeState.FREE, ScopeState.SCANNING
Sent = Callable[[], list[str]]


@dataclass(frozen=True)
class Watched:
    """A maker whose shadow is watched.

    Attributes:
        asked: returns what was asked for in the bytes of a connection, in words.
        allowed: a pattern of all questions, written from the maker's manual and not from the driver.
    """

    name: str
    asked: Callable[[bytes], Iterator[str]]
    allowed: str
    emulator: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    fault: str = "no-reply"

    @property
    def panel(self) -> Panel:
        return next(panel for name, panel in PANELS.items() if name.lower() == self.name)

    @property
    def maker(self) -> Maker:
        return MAKERS[self.name]


def _igor(sent: bytes) -> Iterator[str]:
    for one in zmtp_objects(sent):
        yield str(one["CallFunction"]["name"])  # type: ignore[index]


def _smartscan(sent: bytes) -> Iterator[str]:
    for one in zmtp_objects(sent):
        script = re.match(r'.*JSON.stringify\(\{"ok": \((.*?)\)\}\); \} catch', str(one["params"]))
        yield script[1] if script else str(one["method"])


def _studio(sent: bytes) -> Iterator[str]:
    for script in lua_scripts(sent):
        code = re.sub(r'"(?:[^"\\]|\\.)*"', "TEXT", script)
        yield from re.findall(r"(\w+)\(", code)
        yield from re.findall(r"(root[.\w]*)\s*=(?!=)", code)


WATCHED = {
    one.name: one
    for one in (
        Watched("nanonis", nanonis_names, r"\w+\.\w*Get|Scan\.(WaitEndOfScan|FrameDataGrab)"),
        Watched("asylum", _igor, r"GV|GS|ARGetStatus|GetBaseName|AfspmLook|AfspmController|AfspmFeedbackOn"),
        Watched(
            "gxsm",
            lambda sent: iter(()),
            r"get\w*|list_\w+|rtquery|y_current|chfname",
            settings=dict(PATIENT),  # garbage is an error at once, and a busy computer answers late
            fault="garbage",
        ),
        Watched(
            "nanosurf",
            _studio,  # functions that are called, and values of Studio that are assigned: of these there are none
            r"(value|value_raw|unit)_get|is_scanning|select|select_main|major|full|list|ipairs|gmatch|type",
            {"release": 18},
            {"release": 18},
        ),
        Watched("park", _smartscan, r"\w+_query|js_connect|js_run|\[[\w., ]*\]|typeof [\w.]+"),
    )
}
STUDIO_19 = replace(WATCHED["nanosurf"], emulator={}, settings={})
"""A Studio that shows begin and end of scans to handlers alone: it can be asked, and not watched."""
each = pytest.mark.parametrize("watched", WATCHED.values(), ids=WATCHED)


@dataclass
class Beside:
    """A translator beside a person, and all that it has sent."""

    made: VendorBench[Any]
    address: str
    settings: dict[str, Any]
    sent: Sent

    def start(self) -> Peer:
        return self.made.start(address=self.address, **self.settings)


Make = Callable[[str], Beside]


@pytest.fixture
def beside(watched: Watched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    monkeypatch.setenv("HOME", str(tmp_path))  # GXSM's bridge has its secret there
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    panel = watched.panel
    with ExitStack() as stack:

        def make(class_: str) -> Beside:
            made = panel.bench(tmp_path, stack, 100.0, {**panel.emulator, **watched.emulator})
            made.translator = class_  # type: ignore[misc]
            settings = {**SOON, **panel.settings, **watched.settings}
            if watched.name == "gxsm":  # its bridge proves its address, so that no tap can stand between
                calls = Calls(made)
                return Beside(made, made.address, settings, lambda: [method for method, *_ in calls.answered])
            tap, address = stack.enter_context(tapped(made.address))
            return Beside(
                made, address, settings, lambda: [what for one in tap.sent for what in watched.asked(bytes(one))]
            )

        yield make


def shadow_of(watched: Watched) -> str:
    shadow: str = resolve_name(watched.panel.bench.translator).shadow
    return shadow


def unasked_for(watched: Watched, sent: Sequence[str]) -> list[str]:
    """Return what is no question."""
    return [one for one in sent if not re.fullmatch(watched.allowed, one)]


def endless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no scan end until it is stopped, or its pause is set, however busy the computer is."""
    monkeypatch.setattr(
        ScanActivity, "end_s", property(lambda scan: scan.stopped_s or scan.start_s + 1e9 + scan.paused_s)
    )


@each
def test_shadow_sends_questions_only_over_a_night_of_a_person(
    watched: Watched, beside: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    night, panel = beside(shadow_of(watched)), watched.panel
    peer, made = night.start(), night.made
    peer.until(FREE)

    def press_start(emulator: Any) -> None:
        watched.maker.start(emulator, made.clock.now_s())

    with monkeypatch.context() as first_scan:
        endless(first_scan)
        # a scan from the panel, with a knob turned meanwhile
        made.at_panel(press_start)
        peer.until(SCANNING)
        # a request from anywhere is refused, whatever it asks for
        for action in (names.RETRACT, names.START_SCAN, names.ENGAGE, names.PULSE):
            assert peer.act(action).code == ControlResponse.ACTION_NOT_SUPPORTED
        assert not peer.set(names.ZCTRL_SETPOINT, 1e-10).ok
        # killed in the middle of the scan, it begins again
        made.kill()
        peer = night.start()
        peer.until(SCANNING)
        # the person stops the scan, moves the frame, scans to the end, and withdraws the tip
        made.at_panel(panel.acts["Stop"])
        peer.until(FREE)
    made.at_panel(panel.acts["frame"])
    peer.until(lambda one: isinstance(one, ActByHand) and one.act is PanelAct.VALUES)
    made.strike(watched.fault)
    assert "UNDEFINED" in states(peer.until(FREE))
    made.at_panel(press_start)
    received = peer.until(SCANNING)
    made.at_panel(panel.end)
    assert scans(received + peer.until(FREE))
    made.at_panel(panel.acts.get("withdraw the tip", panel.acts["Stop"]))
    # the end of the run moves nothing either
    made.let_go()
    sent = night.sent()
    assert len(sent) > 50
    assert unasked_for(watched, sent) == []


@pytest.mark.parametrize("watched", [*WATCHED.values(), STUDIO_19], ids=[*WATCHED, "nanosurf 19"])
def test_contact_reads_the_settings_and_sends_questions_only(watched: Watched, beside: Make) -> None:
    night = beside(shadow_of(watched))
    found = contact(resolve_name(shadow_of(watched)).once(address=night.address, **night.settings))
    assert found.lost is None
    assert (None if found.status is None else found.status.state) is (None if watched is STUDIO_19 else FREE)
    bias = found.answers.get(names.TIP_BIAS_VOLTAGE)
    assert (bias is None) == (watched.name == "nanosurf")  # Studio has none without a second device
    assert bias is None or bias.value == pytest.approx(night.made.emulator.rig.setup.bias_v)
    assert found.answers[names.ZCTRL_SETPOINT].value
    assert {"x", "y"} <= {name[-1] for name in found.reach}
    unread = [name for name, one in found.answers.items() if one.value is None and one.was_asked]
    assert unread == []
    sent = night.sent()
    assert len(sent) > 5
    assert unasked_for(watched, sent) == []


@each
def test_run_that_commands_does_send_more_than_questions(watched: Watched, beside: Make) -> None:
    night = beside(watched.panel.bench.translator)
    peer = night.start()
    peer.until(FREE)
    assert peer.act_once_free(names.START_SCAN).ok
    assert unasked_for(watched, night.sent())


@each
def test_shadow_process_has_no_method_that_sets_or_acts(watched: Watched) -> None:
    driver, shadow = resolve_name(watched.panel.bench.translator), resolve_name(shadow_of(watched))
    acting = [name for name in dir(driver) if hasattr(getattr(driver, name, None), "_afspm_action")]
    assert len(acting) > 3
    assert [name for name in (*acting, "set", "write", "command") if getattr(shadow, name) is not None] == []


@pytest.mark.parametrize(
    "watched", [WATCHED[name] for name in ("asylum", "nanosurf", "park")], ids=lambda one: one.name
)
def test_stop_is_published_though_the_next_scan_begins_before_a_file_is_missed(
    watched: Watched, beside: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    endless(monkeypatch)
    night, panel = beside(shadow_of(watched)), watched.panel
    night.settings["result_timeout_s"] = 1e6
    peer, made = night.start(), night.made
    peer.until(FREE)

    def begin(emulator: Any) -> None:
        watched.maker.start(emulator, made.clock.now_s())

    def end(emulator: Any) -> None:
        emulator.rig.scan.paused_s = -1e9

    def until_seen(value: float) -> list[Any]:
        # values are read before the state, and published after it
        made.at_panel(panel.turn(value))
        return peer.until(lambda one: isinstance(one, ActByHand) and one.act is PanelAct.VALUES)

    made.at_panel(begin)
    peer.until(SCANNING)
    received = until_seen(2.0)
    first = made.emulator.rig.scan
    made.at_panel(panel.acts["Stop"])
    received += until_seen(3.0)
    made.at_panel(begin)
    received += until_seen(4.0)
    assert states(received) == []
    until(cast(Any, made), lambda: made.emulator.rig.scan is not first)  # some begin only after a ramp
    made.at_panel(end)
    received = peer.until(FREE) + peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE", "SCANNING", "FREE"]
    assert {scan.filename for scan in scans(received)}
