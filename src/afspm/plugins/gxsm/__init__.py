"""Driver of GXSM 3 and 4, over Gxsm4's shared memory or a script in its console. See the README in this folder.

**Theory of operation.** GXSM reports no events and no end of a measurement, and hides most errors: `set` and `action`
return no error for an unknown name or a refused value. So names are checked against GXSM's own lists at the start,
values are read back, and states are derived from polls of status bits, line numbers and file names (`activity`).

    inputs        results of calls (`link`: `shared_memory` or `bridge_client`); new files, which appear late, one by
                  one, and half written (`result_files`)
    state         the running and the ended measurement, rows of GXSM's memory before a scan (`scan_memory`), the target
                  position of the tip: all persistent
    outputs       calls; scans and spectra from files; lines of the running scan from memory
    invariants    one call at a time; no call that waits for the end of a scan, as such a call blocks GXSM forever; a
                  scan is not published if its first or last row or its first or last columns still hold the previous
                  scan, or if its frame was moved meanwhile; a file is read only once two polls have found the same size
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Final

from afspm.basics import ConfigError, Duration, Refused
from afspm.driver import (
    CENTER,
    FEEDBACK_ON,
    FRAME,
    POSITION,
    ControllerLost,
    Driver,
    Introduction,
    KeptSettings,
    Stated,
    Value,
    VariableRoles,
    action,
    connected,
    frame,
)
from afspm.model import ControlResponse, Scan, ScanLines, ScopeState, ScopeStatus, Spectrum, both_ways, names
from afspm.plugins.gxsm import bridge
from afspm.plugins.gxsm.activity import SHOWS_S, ConnectedGxsm, GxsmActivity, Saving
from afspm.plugins.gxsm.errors import BadReply
from afspm.plugins.gxsm.hardware import (
    ABORT,
    APPROACH,
    AUTOSAVE,
    REPEAT_OFF,
    Hardware,
    Offered,
    available,
    execute,
    recognised,
)
from afspm.plugins.gxsm.link import Address, Asking, Link, open_link
from afspm.plugins.gxsm.result_files import LATE_S, SOON_S, GxsmFiles
from afspm.plugins.gxsm.scan_memory import new_lines
from afspm.plugins.gxsm.settings import (
    REFNAMES,
    SUBSCAN,
    FeedbackSwitch,
    FrameSettings,
    ScanFrame,
    TipPlace,
    number,
    send,
    user_unit_m,
)

_SIGNALS: Final = "f"
"""Code of `rtquery` for frequency shift in Hz, current in nA, and a third value."""
_AT_FIRST: Final[dict[str, Value]] = {names.SPEC_KIND: "IV", names.PULSE_VOLTAGE: 4.0, names.PULSE_DURATION: 0.1}
_SAVERS: Final = ("afspm", "gxsm")
_CHANNELS: Final = both_ways(
    {
        "height": ["ZS-Topo", "Topo"],
        "current": ["I-Tunnel"],
        "amplitude": ["Ampl"],
        "phase": ["Phase"],
        "frequency shift": ["dFreq"],
        "excitation": ["Exec"],
        "other": [f"ADC{number}" for number in range(8)] + [f"MIX{number}" for number in range(4)],
    },
    "{}",
    "{} Backward",
)


_VARIABLES: Final = VariableRoles.declared(
    {
        "bias": ["Bias-mon"],
        "height": ["Z-mon"],
        "current": ["CurrentSim1", "ADC0-I", "In 0"],
        "current, retrace": ["Current Retrace"],
        "conductance": ["dI/dV"],
        "force": ["Force"],
        "force, retrace": ["Force Retrace"],
        "deflection": ["Deflection"],
        "deflection, retrace": ["Deflection Retrace"],
        "frequency shift": ["dFreq"],
        "frequency shift, retrace": ["dFreq Retrace"],
        "amplitude": ["Ampl", "McBSP Ampl"],
        "excitation": ["Exec", "McBSP Exec"],
    }
)


class Gxsm(Driver):
    """The driver of a microscope that GXSM controls.

    Args:
        address: "HOST:PORT" of `bridge.py` in GXSM's console; "shm" for the shared memory of a Gxsm4 on this computer,
            "shm:BLOCK@PROCESS" if the block or the process has another name.
        saving: "afspm": Auto Save is off during this translator's scans, and on at other times; a complete scan is
            saved once, at its end. "gxsm": the driver does not switch Auto Save, which must be on.
        hardware: "SRanger", "RPSPMC" or "simulator", if detection is wrong.
        scan_dir: folder of scans. Default: the folder that GXSM reports for channels.
        probe_dir: folder of spectra. Default: the folder of scans.
        feedback_actions: names of the actions that switch the feedback on and off, in this order.
        secret_file: a copy of the bridge's `~/.afspm/gxsm-bridge-secret`, if GXSM runs on another computer.
        reply_timeout_s: longest wait for a reply, real time.
        common: settings of every driver.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    translated = (*FRAME, *CENTER, *POSITION, FEEDBACK_ON, names.CONTROLLER, *_AT_FIRST)
    channel_roles = _CHANNELS
    variable_roles = _VARIABLES
    maker: ClassVar[str] = "Gxsm project"
    software: ClassVar[str] = "Gxsm"
    counts_clockwise: ClassVar[bool] = True
    max_pixels: ClassVar[int] = 8192 * 8192
    program_s: ClassVar[float] = 2.0
    coarse_commands: ClassVar[str] = "^DSP_CMD_MOV"
    never_shows: ClassVar = {"stop of a spectrum": "GXSM shows nothing of it"}
    shadow: ClassVar[str] = "afspm.plugins.gxsm.shadow.GxsmShadow"

    def __init__(
        self,
        *,
        address: str = "127.0.0.1:65431",
        saving: str = "afspm",
        hardware: str | None = None,
        scan_dir: str | None = None,
        probe_dir: str | None = None,
        feedback_actions: tuple[str, str] | None = None,
        secret_file: str | None = None,
        reply_timeout_s: Duration = 5.0,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        kinds = [kind.value for kind in Hardware]
        if hardware is not None and hardware not in kinds:
            raise ConfigError(f"unknown hardware {hardware!r}", where="hardware", hint=f"one of {', '.join(kinds)}")
        if saving not in _SAVERS:
            raise ConfigError(f"{saving!r} is not a way of saving", where="saving", hint=f"{' or '.join(_SAVERS)}")
        self.controller_at = address
        Address.parse(address)
        scans, probes = (None if path is None else Path(path) for path in (scan_dir, probe_dir))
        self._saving = Saving(saving == "afspm", scans, probes)
        self._given_hardware = hardware
        self._feedback_actions: Sequence[str] = feedback_actions or ()
        secret = None if secret_file is None else Path(secret_file)
        self._open = partial(open_link, timeout_s=reply_timeout_s, secret_file=secret)
        self._whole_table = self.table
        self._asking: Asking | None = None
        self._kept = KeptSettings(_AT_FIRST)

    @classmethod
    def introductions(cls) -> Callable[[str], Introduction]:
        return partial(bridge.Introduction, bridge.secret())

    @classmethod
    def excused(cls, controller: str) -> Mapping[str, str]:
        """Return the conformance checks that GXSM's own simulator fails, with the reason; empty for real hardware."""
        if not controller.endswith(f"({Hardware.SIMULATOR.value})"):
            return {}
        return {
            "scan/picture": "GXSM's simulator turns its picture against the direction in which GXSM turns the frame"
        }

    def connect(self) -> None:
        """Open the link; detect the hardware, the panel's unit of lengths, and whether Auto Save can be switched."""
        self.close()
        ask = self._asking = Asking(self._open_link())
        self.prove()
        folder = ask.working_folder()  # the same by the bridge and by the shared memory
        self.identity = "" if folder is None else f"GXSM in the folder {folder}"
        # the lists are the only proof that a name exists: neither `set`, `get` nor `action` reports an unknown name
        refnames, actions = ask.names("list_refnames"), ask.names("list_actions")
        missing = [ref for ref in REFNAMES if ref not in refnames]
        if missing:
            raise ControllerLost(f"this GXSM has no {', '.join(missing)}", where="list_refnames")
        found = recognised(refnames, actions)
        hardware = Hardware(self._given_hardware) if self._given_hardware else found
        self._offered = Offered(refnames, actions, hardware)
        lacking = self._find_parameters()
        self.lacking = self._missing_actions()
        scan_frame = ScanFrame(ask, user_unit_m(ask))
        can_switch = self._offered.actions.issuperset(AUTOSAVE.values())
        saving = replace(self._saving, switches_autosave=self._saving.by_us and can_switch)
        self._kept.kept_in(self.memory)
        gxsm = ConnectedGxsm(ask, hardware, scan_frame, refnames.issuperset(SUBSCAN))
        self._files = GxsmFiles(
            self.memory,
            self.log,
            patience_s=self.patience_s(self.common.result_timeout_s / 2),
            soon_s=self.patience_s(SOON_S),
            late_s=self.patience_s(LATE_S),
            ends_early=gxsm.ends_early,
        )
        self._activity = GxsmActivity(
            gxsm,
            self._files,
            self.memory,
            self.clock,
            self.log,
            set_frame=lambda: frame(self.in_force(FRAME)),
            shows_s=self.patience_s(SHOWS_S),
            saving=saving,
        )
        self._activity.require_channels()
        self._activity.look()
        self._tip = TipPlace(scan_frame, self.memory, self._sets_out)
        own = FrameSettings(scan_frame, self._tip, is_led=self._offered.hardware is Hardware.RPSPMC)
        feedback = FeedbackSwitch(ask, self._activity.gxsm.doing, self._feedback_actions)
        self.groups = (own, self._tip, self._kept, feedback)
        self.log.info("GXSM with the hardware %s; unsupported: %s", self._offered.kind, ", ".join(lacking) or "none")

    def _open_link(self) -> Link:
        return self._open(Address.parse(self.controller_at), monotonic_s=self.clock.monotonic_s)

    def _find_parameters(self) -> list[str]:
        table = self._whole_table
        vendors = {name: spec.vendor for name, spec in table.items() if name not in self.translated}
        there = available(vendors, self._offered.refnames)
        lacking = sorted(vendors.keys() - there.keys())
        if self._feedback_actions and self._offered.actions.issuperset(self._feedback_actions):
            table = table.extended({FEEDBACK_ON: {"read_only": False}}, where="feedback_actions")
        self.table = table.without(lacking)
        return lacking

    def _missing_actions(self) -> dict[str, str]:
        # GXSM returns 0 also for unknown actions and does nothing, so the actions are checked against its list at the
        # start.
        needed = {names.ENGAGE: [APPROACH], names.STOP_SPEC: [ABORT]}
        if names.TIP_BIAS_VOLTAGE not in self.table:
            needed[names.PULSE] = [names.TIP_BIAS_VOLTAGE]
        needed[names.START_SPEC] = [execute(kind) for kind in self._whole_table[names.SPEC_KIND].choices]
        for name, what in self.common.actions.items():
            if "command" in what:
                needed[name] = [str(what["command"])]
        return {
            name: f"this GXSM has no action {' or '.join(wanted[:3])} with its hardware ({self._offered.kind})"
            for name, wanted in needed.items()
            if self._offered.actions.isdisjoint(wanted)
        }

    def close(self) -> None:
        if self._asking is not None:
            self._asking.close()
            self._asking = None

    @property
    def _ask(self) -> Asking:
        return connected(self._asking, "GXSM")

    def status(self) -> ScopeStatus:
        return self._activity.status()

    def next_change_s(self) -> float | None:
        return self._activity.next_change_s()

    # --- parameters ---

    def get(self, vendor: str) -> Value:
        if vendor == names.CONTROLLER:
            return f"{self._files.program or 'GXSM'} ({self._offered.kind})"
        try:
            return number(self._ask, self._there(vendor))
        except BadReply as error:
            raise Refused(ControlResponse.PARAM_ERROR, str(error)) from error

    def set(self, values: Mapping[str, Value]) -> None:
        for vendor, value in values.items():
            send(self._ask, self._there(vendor), float(value))

    def _there(self, vendor: str) -> str:
        # `get` returns -inf or uninitialised memory for an unknown name, `set` 0: neither reports that the name is
        # unknown.
        there = available({"": vendor}, self._offered.refnames)
        if not there:
            raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, f"this GXSM has no parameter {vendor!r}")
        return there[""]

    def _way_s(self, way_m: float) -> float:
        if names.MOVE_SPEED not in self.table:
            return 0.0
        speed_m_s = float(self.read_rows([names.MOVE_SPEED])[names.MOVE_SPEED])
        return way_m / speed_m_s if speed_m_s > 0.0 else 0.0

    def _sets_out(self, way_m: float) -> None:
        self._activity.sets_out(self._way_s(way_m))

    # --- results ---

    def results(self) -> Sequence[str]:
        return self._files.results(self.clock.now_s())

    def followed(self) -> bool | None:
        return self._files.followed()

    def stopped_by_hand(self) -> str:
        return self._files.stopped_by_hand()

    def stated(self, result: str) -> Stated:
        return self._files.stated(result)

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        return self._files.load(result)

    def lines(self, start: int) -> Sequence[ScanLines]:
        """Return new lines from GXSM's memory, for channels that were in the files of an earlier scan."""
        endings = self._activity.endings()
        if not endings or self._files.spoiled:
            return ()
        done = self._activity.lines_done()
        found = new_lines(self._ask, endings, self._files.channels, self._files.scanning, start, done)
        # after a stop GXSM reports the frame's last line, as if all lines were complete
        return found if self._activity.gxsm.doing().measuring else ()

    # --- actions ---

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        """Scan the frame once, with the channels and direction set on GXSM's panel."""
        # with Repeat on, the scan would never end
        if REPEAT_OFF in self._offered.actions:
            self._ask.call("action", REPEAT_OFF)
        self._activity.start_scan()

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        self._activity.stop_scan()

    @action(names.START_SPEC)
    def start_spec(self) -> None:
        """Take a spectrum of the kind `x-spec-kind` at the probe position, after moving the tip back there."""
        kind = str(self._kept[names.SPEC_KIND])
        if execute(kind) not in self._offered.actions:
            reason = f"this GXSM has no {execute(kind)} with its hardware ({self._offered.kind}): see x-spec-kind"
            raise Refused(ControlResponse.ACTION_NOT_SUPPORTED, reason)
        reach_m = math.hypot(*self._tip.frame.region().size_m)
        self._activity.start_curve(kind, self._tip.xy_m(), self._way_s(reach_m))

    @action(names.STOP_SPEC)
    def stop_spec(self) -> None:
        self._activity.stop_curve()

    def current_a(self) -> float | None:
        if self._asking is None or self._offered.hardware is Hardware.SIMULATOR:
            return None
        _, current_na, *_ = self._asking.numbers("rtquery", _SIGNALS)
        return current_na * 1e-9

    @action(names.PULSE, state=ScopeState.BUSY_PARAM)
    def pulse(self) -> None:
        self.pulse_bias()

    @action(names.ENGAGE, state=ScopeState.COARSE_MOTOR)
    def engage(self) -> None:
        """Start the auto approach."""
        self._ask.call("action", APPROACH)

    def command(self, text: str) -> None:
        """Execute a GXSM action, e.g. "DSP_CMD_STOPALL"."""
        self._ask.call("action", text)
