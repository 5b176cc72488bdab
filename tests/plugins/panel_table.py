"""Acts at the panels of the emulated controllers, and what follows: the tables of docs/reference/at-the-panel.md.

PYTHONPATH=tests/support python -m tests.plugins.panel_table     # writes them again
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, Final

from deadlines import DEADLINE_S
from tests.plugins.asylum.asylum_bench import Bench as AsylumBench
from tests.plugins.by_hand import acts
from tests.plugins.gxsm.gxsm_bench import Bench as GxsmBench
from tests.plugins.gxsm.gxsm_bench import hold_scan, scan_until_line
from tests.plugins.gxsm.test_gxsm_at_panel import held
from tests.plugins.gxsm.test_gxsm_at_panel import small as small_in_gxsm
from tests.plugins.nanonis.nanonis_bench import Bench as NanonisBench
from tests.plugins.nanosurf.nanosurf_bench import Bench as NanosurfBench
from tests.plugins.nanosurf.test_nanosurf_at_panel import LINE_S, LINES, Scripts, press, put
from tests.plugins.park.park_bench import Bench as ParkBench
from tests.plugins.vendor_bench import TURNED, Peer, VendorBench, ready, scanned, scans, small, states

from afspm.model import (
    ActByHand,
    ControlResponse,
    Feedback,
    PanelAct,
    ScopeState,
    ScopeStatus,
    Spectrum,
    names,
)
from afspm.scheduler.control.panel_state import PanelState

PAGE: Final = Path(__file__).parents[2] / "docs" / "reference" / "at-the-panel.md"
_MARK: Final = "<!-- generated: acts at the panels -->\n"
_NOTHING: Final = "nothing is seen"
_WITHDRAW: Final = "withdraw the tip"
_FEEDBACK: Final = "z controller off"
_AGAIN_S: Final = 2.0
Hand = Callable[[Any], object]


class When(StrEnum):
    """The moment of an act; the text names what is measured then, for the cells."""

    BETWEEN = ""
    SCAN = "scan"
    SPECTRUM = "spectrum"


_NEVER: Final = {When.BETWEEN: ("Stop",), When.SCAN: ("Start",), When.SPECTRUM: ("Start",)}
"""Acts that are not possible between two scans, in a scan, in a spectrum."""
_ENDLESS: Final = {"iv": {"duration_s": 1e6}, "force": {"duration_s": 1e6}}
"""Spectra that last until `_end_spectrum`, for the emulators."""


@dataclass(frozen=True)
class Panel:
    """A maker's emulated controller with a person at its panel.

    Attributes:
        acts: what the person does, by its name on the page.
        turn: turns the knob of the parameter `knob` to a value, in V or as far.
        setpoint: turns the setpoint, which is published whenever it is read, in a spectrum as well.
        stop_spectrum: stops a spectrum.
        endless: acts after which a scan has no end that a test can wait for.
        end: lets the running scan end with all its lines.
        scan_speed: at which a scan lasts longer than the acts, in m/s.
        start: starts the translator; begin: starts a scan of the run that lasts. By default with `scan_speed`.
        settings: of the translator; emulator: of the emulator.
    """

    bench: type[VendorBench[Any]]
    acts: Mapping[str, Hand]
    turn: Callable[[float], Hand]
    setpoint: Callable[[float], Hand]
    stop_spectrum: Hand
    end: Hand
    scan_speed: float = 1e-9
    start: Callable[..., Peer] = small
    begin: Callable[[Any, Peer], object] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    emulator: Mapping[str, Any] = field(default_factory=dict)
    speed: float = 10.0
    knob: str = names.TIP_BIAS_VOLTAGE
    endless: frozenset[str] = frozenset()


def _now(emulator: Any) -> float:
    now_s: float = emulator.clock.now_s()
    return now_s


def _end_of_rig(emulator: Any) -> None:
    if emulator.rig.scan is not None:
        emulator.rig.scan.paused_s -= emulator.rig.scan.end_s - _now(emulator)  # its file states an end after its start


def _end_spectrum(emulator: Any) -> None:
    program, rig = getattr(emulator, "software", None), emulator.rig
    for curve in (rig.spectrum, None if program is None else program.spectra.running):
        if curve is not None:
            object.__setattr__(curve, "end_s", _now(emulator))
    rig._held_until_s = _now(emulator) + rig.world.settings.feedback.hold_s


def _nanonis(name: str, *arguments: object) -> Hand:
    return lambda emulator: emulator.software.functions.call(name, list(arguments))


def _asylum(name: str, value: float) -> Hand:
    return lambda emulator: emulator.controller.put(name, value, _now(emulator))


def _park(kind: str, path: str, value: object) -> Hand:
    return lambda emulator: emulator.program.ask(kind, path, [value])


def _gxsm(name: str, value: float) -> Hand:
    return lambda emulator: emulator.program.entries.set(name, repr(value))


def _begin_in_gxsm(made: Any, peer: Peer) -> None:
    scanned(peer)  # before its first scan GXSM's memory is empty
    held(made, peer)


def _small_in_studio(made: Any, **settings: Any) -> Peer:
    peer: Peer = made.start(**settings)
    ready(peer, shape=(LINES, 2))
    return peer


def _begin_in_studio(made: Any, peer: Peer) -> None:
    assert peer.set(names.SCAN_SPEED, 2.0 * TURNED.size_m[0] / LINE_S, "m/s").ok
    scripts = Scripts(made)
    assert peer.act_once_free(names.START_SCAN).ok
    scripts.until_lines_are_seen()


def _studio(path: str, value: object) -> Hand:
    return lambda emulator: put(emulator, path, value)


def _start_gxsm(emulator: Any) -> None:
    hold_scan(emulator.program, 1)
    emulator.program.start_scan()


def _stop_gxsm(emulator: Any) -> None:
    scan_until_line(emulator.program, 4)
    emulator.program.stop_scan()


def _stop_spectrum_in_gxsm(emulator: Any) -> None:
    emulator.rig.stop_spectrum(_now(emulator))
    emulator.program.curve = None


PANELS: Final = {
    "Nanonis": Panel(
        NanonisBench,
        {
            "Stop": _nanonis("Scan.Action", 1, 0),
            "Start": _nanonis("Scan.Action", 0, 1),
            _WITHDRAW: _nanonis("ZCtrl.Withdraw", 0, -1),
            _FEEDBACK: _nanonis("ZCtrl.OnOffSet", 0),
            "frame": _nanonis("Scan.FrameSet", 5e-6, 0.0, 500e-9, 500e-9, 0.0),
        },
        lambda volts: _nanonis("Bias.Set", volts),
        lambda part: _nanonis("ZCtrl.SetpntSet", part * 1e-10),
        _nanonis("BiasSpectr.Stop"),
        _end_of_rig,
        1e-10,
        speed=100.0,
    ),
    "Asylum": Panel(
        AsylumBench,
        {
            "Stop": lambda emulator: emulator.controller.stop(_now(emulator)),
            _WITHDRAW: lambda emulator: emulator.controller.stop(_now(emulator)),
            _FEEDBACK: lambda emulator: emulator.controller.feedback_off(_now(emulator)),
            "frame": _asylum("XOffset", 3e-6),
        },
        lambda volts: _asylum("TipVoltage", volts),
        lambda part: _asylum("AmplitudeSetpointVolts", part),
        lambda emulator: emulator.controller.stop(_now(emulator)),
        _end_of_rig,
        settings={"result_timeout_s": 5.0},
        emulator={"start_s": 0.0},
    ),
    "GXSM": Panel(
        GxsmBench,
        {
            "Stop": _stop_gxsm,
            "Start": _start_gxsm,
            _FEEDBACK: lambda emulator: emulator.program.switch_feedback(on=False),
            "frame": _gxsm("OffsetX", 30.0),
        },
        lambda volts: _gxsm("dsp-fbs-bias", volts),
        lambda part: _gxsm("dsp-fbs-mx0-current-set", part),
        _stop_spectrum_in_gxsm,
        lambda emulator: scan_until_line(emulator.program, 1),
        start=small_in_gxsm,
        begin=_begin_in_gxsm,
        speed=100.0,
    ),
    "Nanosurf": Panel(
        NanosurfBench,
        {
            "Stop": partial(press, button="stop_scan"),
            "Start": partial(press, button="start_scan"),
            _WITHDRAW: partial(press, button="withdraw"),
            "frame": _studio("imaging.frame_center_offset_x", 90e-9),
        },
        lambda volts: _studio("z_control.setpoint", volts),
        lambda part: _studio("z_control.setpoint", part),
        lambda emulator: emulator.program.stop_curve(),
        lambda emulator: None,
        start=_small_in_studio,
        begin=_begin_in_studio,
        settings={"result_timeout_s": 20.0},
        speed=100.0,
        knob=names.ZCTRL_SETPOINT,
        endless=frozenset({"frame", names.ZCTRL_SETPOINT}),
    ),
    "Park": Panel(
        ParkBench,
        {
            "Stop": lambda emulator: emulator.program.stop_scan(_now(emulator)),
            _WITHDRAW: lambda emulator: emulator.program.withdraw(_now(emulator)),
            _FEEDBACK: _park("set", "zservo.enable", False),
            "frame": _park("call", "scan.setScanGeometry", {"offsetX": 3.0}),
        },
        lambda volts: _park("set", "bias.tip", volts),
        lambda part: _park("set", "zservo.setpoint.value", part),
        lambda emulator: emulator.program.stop_curve(),
        lambda emulator: None,  # the driver knows a stopped scan by its duration
        3e-7,
        settings={"result_timeout_s": 5.0},
        emulator={"start_s": 0.0},
    ),
}


def cell(panel: Panel, act: str, when: When, folder: Path) -> str:
    """Return what follows an act, during a scan or spectrum of the run or between two scans, in words."""
    with ExitStack() as stack:
        lasting = _ENDLESS if when is When.SPECTRUM else {}
        made = panel.bench(folder, stack, panel.speed, {**panel.emulator, **lasting})
        # a spectrum that ends by itself has a file, which a busy computer writes late
        ends = when is When.SPECTRUM and act not in ("Stop", _WITHDRAW)
        patient = {"result_timeout_s": DEADLINE_S * panel.speed} if ends else {}
        peer = panel.start(made, **{**panel.settings, **patient})
        if panel.begin is None:
            assert peer.set(names.SCAN_SPEED, panel.scan_speed).ok
        if when is When.SPECTRUM:
            received = _in_spectrum(made, peer, panel, act)
        else:
            received = _beside_spectra(made, peer, panel, act, when)
        answer = peer.act(names.START_SCAN)
        kept = received if act == panel.knob else _without(panel.knob, received)
        if when is When.SPECTRUM and act != names.ZCTRL_SETPOINT:
            kept = _without(names.ZCTRL_SETPOINT, kept)
        return "; ".join(_in_words(kept, when, start=f"{answer.code} {answer.reason}"))


def _beside_spectra(made: VendorBench[Any], peer: Peer, panel: Panel, act: str, when: When) -> list[Any]:
    if when is When.SCAN:
        _begin(made, peer, panel)
    _until_all_is_seen(made, peer, panel)
    received: list[Any] = []
    if act != panel.knob:
        made.at_panel(panel.acts[act])
    if act == "Start":
        received += peer.until(ScopeState.SCANNING)
    received += _until_all_is_seen(made, peer, panel)
    if act == _FEEDBACK:  # one reading is no proof
        received += _until_all_is_seen(made, peer, panel)
    is_measuring = when is When.SCAN or PanelAct.SCAN in acts(received)
    if is_measuring and ScopeStatus(ScopeState.FREE) not in received:
        made.at_panel(panel.end)
        received += peer.until(ScopeState.FREE)
    return received


def _in_spectrum(made: VendorBench[Any], peer: Peer, panel: Panel, act: str) -> list[Any]:
    _until_all_is_seen(made, peer, panel)
    assert peer.act_once_free(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    parts = itertools.count(0.4, 1 / 64)
    while made.emulator.rig.spectrum is None:  # the tip goes to its place first
        _until_read(made, peer, panel, parts)
    _until_read(made, peer, panel, parts)
    made.at_panel(panel.turn(3.0) if act == panel.knob else {**panel.acts, "Stop": panel.stop_spectrum}[act])
    received: list[Any] = []
    if act != "Stop":
        received += _until_read(made, peer, panel, parts)
        if ScopeStatus(ScopeState.FREE) not in received:
            made.at_panel(_end_spectrum)
    if ScopeStatus(ScopeState.FREE) not in received:
        received += peer.until(ScopeState.FREE)
    if act == panel.knob:  # seen without a further turn, by a busy computer even before the end
        is_seen = any(_changes(panel.knob, one) for one in received)
        return received if is_seen else received + peer.until(lambda one: _changes(panel.knob, one))
    return received + _until_all_is_seen(made, peer, panel)


def _until_read(made: VendorBench[Any], peer: Peer, panel: Panel, parts: Iterator[float]) -> list[Any]:
    received: list[Any] = []
    for part in parts:
        made.at_panel(panel.setpoint(part))
        while peer.has_news(_AGAIN_S):
            received.append(peer.next())
            if isinstance(received[-1], Feedback):
                return received
    raise AssertionError


def _begin(made: VendorBench[Any], peer: Peer, panel: Panel) -> None:
    if panel.begin is not None:
        panel.begin(made, peer)
        return
    assert peer.act_once_free(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    for _ in range(2):  # each request looks at the scan first
        peer.set(names.SCAN_RESOLUTION_X, 16)


def _until_all_is_seen(made: VendorBench[Any], peer: Peer, panel: Panel) -> list[Any]:
    # A knob that is turned afterwards is seen by the same reading at the earliest. A reading that follows a request, or
    # sees the tip move, is no evidence: then it is turned once more.
    received: list[Any] = []
    for volts in itertools.count(0.25, 0.125):
        made.at_panel(panel.turn(volts))
        while peer.has_news(_AGAIN_S):
            received.append(peer.next())
            if _changes(panel.knob, received[-1]):
                return received
    raise AssertionError


def _changes(knob: str, packet: object) -> bool:
    return isinstance(packet, ActByHand) and knob in {one.parameter for one in packet.changes}


def _without(knob: str, received: Sequence[Any]) -> list[Any]:
    kept: list[Any] = []
    for one in received:
        if _changes(knob, one):
            rest = tuple(change for change in one.changes if change.parameter != knob)
            kept += [replace(one, changes=rest)] if rest else []
        else:
            kept.append(one)
    return kept


def _in_words(received: Sequence[Any], when: When, *, start: str) -> list[str]:
    told = [one for one in received if isinstance(one, ActByHand)]
    seen = ["the values" if one.act is PanelAct.VALUES else one.act.value for one in told]
    waits = any(PanelState().asks_for_pause(one, stopped="pause", changed="tell") for one in told)
    words = [f"seen: {', '.join(dict.fromkeys(seen))}" if seen else _NOTHING]
    if when:
        is_there = bool(scans(received)) or any(isinstance(one, Spectrum) for one in received)
        words.append(f"the {when} is {'complete' if is_there else 'interrupted'}")
        assert is_there is not ("INTERRUPTED" in states(received))
    words.append("the run waits" if waits else "the run goes on")
    if start.startswith(f"{int(ControlResponse.NOT_FREE)} ") and "the panel" in start:
        words.append("no start before the tip is at work again")
    return words


def table(maker: str) -> str:
    """Return the section of a maker: what follows its acts, between two scans and in a measurement of the run."""
    panel = PANELS[maker]
    head = "| act | between two scans | in a scan of the run | in a spectrum of the run |"
    text = [f"## {maker}\n", head, "| --- | --- | --- | --- |"]
    for act in (*panel.acts, panel.knob):
        cells = []
        for when in When:
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
                nothing = act in _NEVER[when] or (when is When.SCAN and act in panel.endless)
                cells.append("" if nothing else cell(panel, act, when, Path(folder)))
        text.append(f"| {act} | {' | '.join(cells)} |")
    return "\n".join(text) + "\n"


if __name__ == "__main__":
    head = PAGE.read_text(encoding="utf-8").partition(_MARK)[0]
    PAGE.write_text(head + _MARK + "\n" + "\n".join(map(table, PANELS)), encoding="utf-8")
    sys.stdout.write(f"{PAGE}\n")
