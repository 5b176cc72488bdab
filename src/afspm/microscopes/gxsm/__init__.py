"""GXSM, versions 3 and 4: over Gxsm4's shared memory, or a script in the console. See the README beside this."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Final

from afspm.errors import ConfigError, Refused
from afspm.microscopes.gxsm.activity import SHOWS_S, Activity
from afspm.microscopes.gxsm.frame import PIXELS, REFNAMES, Frame, number, send, user_unit_m
from afspm.microscopes.gxsm.hardware import (
    ABORT,
    APPROACH,
    AUTOSAVE_OFF,
    REPEAT_OFF,
    Hardware,
    available,
    execute,
    recognised,
)
from afspm.microscopes.gxsm.link import Address, Asking, open_link
from afspm.microscopes.gxsm.live import new_lines
from afspm.microscopes.gxsm.result_files import SOON_S, GxsmFiles
from afspm.model import ControlResponse, Scan, ScanLines, ScopeState, ScopeStatus, Spectrum, names
from afspm.translator.driver import ControllerLost, Driver, action
from afspm.translator.parameters import FEEDBACK_ON, Value
from afspm.translator.settings import FRAME, POSITION, frame
from afspm.units import Duration

_SAVERS: Final = ("afspm", "gxsm")


class Gxsm(Driver):
    """The microscope behind GXSM.

    Args:
        address: "HOST:PORT" of `bridge.py` in GXSM's console; "shm" for the shared memory of a Gxsm4 on this computer,
            "shm:BLOCK@PROCESS" if that or its process is not called as usual.
        saving: "afspm": GXSM's Auto Save is switched off, and it is told to save once after each scan; "gxsm": its
            Auto Save is left on, and its files are waited for.
        hardware: "SRanger", "RPSPMC" or "simulator", if the kind that is found is wrong.
        scan_dir, probe_dir: where scans and spectra are saved, if not where GXSM says that it saves channels.
        feedback_actions: GXSM's actions that switch the feedback on and off, where its hardware has such.
        secret_file: a copy of the bridge's `~/.afspm/gxsm-bridge-secret`, if GXSM runs on another computer.
        reply_timeout_s: how long an answer may take, in real time.
        parameters, actions, poll_period_s, result_timeout_s, live_lines_s: as for every microscope.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    translated = (*Frame.names, *POSITION, FEEDBACK_ON, names.SPEC_KIND, names.CONTROLLER)
    kept = MappingProxyType({names.PULSE_VOLTAGE: 4.0, names.PULSE_DURATION: 0.1})
    max_pixels: ClassVar[int] = 8192 * 8192
    program_s: ClassVar[float] = 2.0

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
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
        actions: Mapping[str, Mapping[str, Any]] | None = None,
        poll_period_s: Duration = 0.1,
        result_timeout_s: Duration = 10.0,
        live_lines_s: Duration | None = None,
    ) -> None:
        super().__init__(
            parameters=parameters,
            actions=actions,
            poll_period_s=poll_period_s,
            result_timeout_s=result_timeout_s,
            live_lines_s=live_lines_s,
        )
        kinds = [kind.value for kind in Hardware]
        if hardware is not None and hardware not in kinds:
            raise ConfigError(f"there is no {hardware!r}", where="hardware", hint=f"there are {', '.join(kinds)}")
        if saving not in _SAVERS:
            raise ConfigError(f"{saving!r} saves nothing", where="saving", hint=f"{' or '.join(_SAVERS)}")
        self.controller_at = address
        Address.parse(address)
        self._saves = saving == "afspm"
        self._given_hardware = hardware
        self._scan_dir, self._probe_dir = (None if path is None else Path(path) for path in (scan_dir, probe_dir))
        self._feedback_actions: Sequence[str] = feedback_actions or ()
        self._secret_file = None if secret_file is None else Path(secret_file)
        self._reply_timeout_s = reply_timeout_s
        self._whole_table = self.table
        self._refs: dict[str, str] = {}
        self._asking: Asking | None = None

    @classmethod
    def excused(cls, controller: str) -> Mapping[str, str]:
        """Return what GXSM's own simulator does otherwise than GXSM itself says."""
        if not controller.endswith(f"({Hardware.SIMULATOR.value})"):
            return {}
        return {"scan/picture": "GXSM's simulator turns its picture the other way than GXSM turns the frame"}

    def connect(self) -> None:
        """The link; what this GXSM has, in which unit it has it, and how it saves."""
        self.close()
        address = Address.parse(self.controller_at)
        ask = self._asking = Asking(
            open_link(address, self._reply_timeout_s, self.clock.monotonic_s, self._secret_file)
        )
        self.prove()
        self._refnames, self._actions = ask.names("list_refnames"), ask.names("list_actions")
        missing = [ref for ref in REFNAMES if ref not in self._refnames]
        if missing:
            raise ControllerLost(f"this GXSM has no {', '.join(missing)}", where="list_refnames")
        found = recognised(self._refnames, self._actions)
        self._hardware = Hardware(self._given_hardware) if self._given_hardware else found
        self._find_parameters()
        self.lacking = self._missing_actions()
        self._frame = Frame(ask, user_unit_m(ask))
        if self._saves and AUTOSAVE_OFF in self._actions:
            ask.call("action", AUTOSAVE_OFF)
            self.log.info("GXSM's Auto Save of scans is off from now on, and stays off: see the setting saving")
        self._kept: dict[str, Any] = self.memory.setdefault("kept", {})
        self._kept.update({names.SPEC_KIND: "IV", "probe": None, **self.kept} | self._kept)
        self._harvest = GxsmFiles(
            self.memory,
            self.patience_s(self.result_timeout_s / 2),
            self.patience_s(SOON_S),
            self.log,
            rewritten=not self._saves,
        )
        self._activity = Activity(
            ask,
            self._hardware,
            self._frame,
            self._harvest,
            self._kept,
            self.clock,
            self.log,
            set_frame=lambda: frame(self.in_force(FRAME)),
            shows_s=self.patience_s(SHOWS_S),
            saves=self._saves,
            scan_dir=self._scan_dir,
            probe_dir=self._probe_dir,
        )

    def _find_parameters(self) -> None:
        table = self._whole_table
        own = {*self.translated, *(name for name in self.kept if table[name].vendor == name)}
        vendors = {name: spec.vendor for name, spec in table.items() if name not in own}
        self._refs = available(vendors, self._refnames)
        lacking = sorted(vendors.keys() - self._refs.keys())
        self._own = [name for name in self.kept if name in own]
        if self._feedback_actions and self._actions.issuperset(self._feedback_actions):
            table = table.extended({FEEDBACK_ON: {"read_only": False}}, where="feedback_actions")
        self.table = table.without(lacking)
        self.log.info("GXSM with the hardware %s; unsupported: %s", self._hardware.value, ", ".join(lacking) or "none")

    def _missing_actions(self) -> dict[str, str]:
        """GXSM says 0 to actions that it does not have."""
        needed = {names.ENGAGE: [APPROACH], names.STOP_SPEC: [ABORT]}
        if names.TIP_BIAS_VOLTAGE not in self.table:
            needed[names.PULSE] = [names.TIP_BIAS_VOLTAGE]
        needed[names.START_SPEC] = [execute(kind) for kind in self._whole_table[names.SPEC_KIND].choices]
        for name, what in self.added_actions.items():
            if "command" in what:
                needed[name] = [str(what["command"])]
        return {
            name: f"this GXSM has no action {' or '.join(wanted[:3])} with its hardware ({self._hardware.value})"
            for name, wanted in needed.items()
            if self._actions.isdisjoint(wanted)
        }

    def close(self) -> None:
        """Let go of the link. What was begun goes on."""
        if self._asking is not None:
            self._asking.close()
            self._asking = None

    @property
    def _ask(self) -> Asking:
        if self._asking is None:
            raise ControllerLost("GXSM is not connected")
        return self._asking

    def status(self) -> ScopeStatus:
        """What GXSM is doing now."""
        return self._activity.status()

    def next_change_s(self) -> float | None:
        """When a move or the wait for files is over."""
        return self._activity.next_change_s()

    # --- parameters ---

    def read(self, wanted: Collection[str]) -> dict[str, Value]:
        """What GXSM has, and what is kept for it."""
        found: dict[str, Value] = {}
        if not set(Frame.names).isdisjoint(wanted):
            found.update(self._frame.read())
        if not set(POSITION).isdisjoint(wanted):
            found.update(zip(POSITION, self._probe_m(), strict=True))
        if FEEDBACK_ON in wanted:
            found[FEEDBACK_ON] = self._activity.doing().feedback_on
        found.update({name: self._kept[name] for name in (names.SPEC_KIND, *self._own)})
        found[names.CONTROLLER] = f"{self._harvest.program or 'GXSM'} ({self._hardware.value})"
        return found | super().read([name for name in wanted if name not in found])

    def write(self, values: Mapping[str, Value]) -> None:
        """The frame first, which the tip's place depends on."""
        framed = {name: value for name, value in values.items() if name in Frame.names}
        if framed:
            self._write_frame(framed)
        position = {name: float(value) for name, value in values.items() if name in POSITION}
        if position:
            x, y = (position.get(name, before) for name, before in zip(POSITION, self._probe_m(), strict=True))
            self._send_probe((x, y))
        kept = {name: values[name] for name in (names.SPEC_KIND, *self._own) if name in values}
        self._kept.update(kept)
        if FEEDBACK_ON in values:
            on, off = self._feedback_actions
            self._ask.call("action", on if values[FEEDBACK_ON] else off)
        own = {*framed, *position, *kept, FEEDBACK_ON}
        super().write({name: value for name, value in values.items() if name not in own})

    def get(self, vendor: str) -> Value:
        """By GXSM's name."""
        return number(self._ask, self._there(vendor))

    def set(self, values: Mapping[str, Value]) -> None:
        """By GXSM's names, one after the other."""
        for vendor, value in values.items():
            send(self._ask, self._there(vendor), float(value))

    def _there(self, vendor: str) -> str:
        """Of the names that a parameter may have, the one that this GXSM has: it does not say of others that it has
        them not."""
        there = available({"": vendor}, self._refnames)
        if not there:
            raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, f"this GXSM has no parameter {vendor!r}")
        return there[""]

    def _probe_m(self) -> tuple[float, float]:
        """Where the tip was sent; GXSM's files of spectra do not tell."""
        kept = self._kept["probe"]
        return self._frame.tip() if kept is None else (float(kept[0]), float(kept[1]))

    def _write_frame(self, framed: Mapping[str, Value]) -> None:
        if self._hardware is not Hardware.RPSPMC or framed.keys() <= PIXELS:
            self._frame.write(framed)
            return
        # the tip goes along with its frame, which a RedPitaya does not tell
        before_m = self._frame.tip()
        self._frame.write(framed)
        self._activity.sets_out(self._way_s(math.dist(before_m, self._frame.tip())))

    def _send_probe(self, xy_m: tuple[float, float]) -> None:
        way_s = self._way_s(math.dist(self._frame.tip(), xy_m))
        self._frame.move_tip(xy_m)
        self._kept["probe"] = list(xy_m)
        self._activity.sets_out(way_s)

    def _way_s(self, way_m: float) -> float:
        """How long the tip takes for so long a way; none if GXSM does not tell its speed."""
        if names.MOVE_SPEED not in self._refs:
            return 0.0
        speed_m_s = float(super().read([names.MOVE_SPEED])[names.MOVE_SPEED])
        return way_m / speed_m_s if speed_m_s > 0.0 else 0.0

    # --- results ---

    def results(self) -> Sequence[str]:
        """The last scans and spectra that GXSM saved."""
        return self._harvest.results(self.clock.now_s())

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        """Read the files of one."""
        return self._harvest.load(result)

    def lines(self, start: int) -> Sequence[ScanLines]:
        """Return what is new in GXSM's memory; of channels that a scan was saved of."""
        endings = self._activity.endings()
        if not endings:
            return ()
        done = self._activity.lines_done()
        found = new_lines(self._ask, endings, self._harvest.channels, self._harvest.scanning, start, done)
        # of a scan that is stopped meanwhile GXSM says that it is at its last line
        return found if self._activity.doing().measuring else ()

    # --- actions ---

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        """Scan the frame once, with the channels and the direction of GXSM's panel."""
        if REPEAT_OFF in self._actions:  # it would never end
            self._ask.call("action", REPEAT_OFF)
        self._activity.start_scan()

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        """Break the scan off."""
        self._activity.stop_scan()

    @action(names.START_SPEC)
    def start_spec(self) -> None:
        """Take a spectrum of the kind `x-spec-kind` where the probe was sent to last: it is sent there again, since a
        scan has moved it."""
        kind = str(self._kept[names.SPEC_KIND])
        if execute(kind) not in self._actions:
            reason = f"this GXSM has no {execute(kind)} with its hardware ({self._hardware.value}): see x-spec-kind"
            raise Refused(ControlResponse.ACTION_NOT_SUPPORTED, reason)
        reach_m = math.hypot(*self._frame.region().size_m)
        self._activity.start_curve(kind, self._probe_m(), self._way_s(reach_m))

    @action(names.STOP_SPEC)
    def stop_spec(self) -> None:
        """Break the spectrum off."""
        self._activity.stop_curve()

    @action(names.PULSE, state=ScopeState.BUSY_PARAM)
    def pulse(self) -> None:
        """A bias pulse of `x-pulse-voltage` for `x-pulse-duration`, where the tip is: the bias is set, and put back."""
        wanted = self.in_force([names.PULSE_VOLTAGE, names.PULSE_DURATION])
        self.for_a_while({names.TIP_BIAS_VOLTAGE: wanted[names.PULSE_VOLTAGE]}, float(wanted[names.PULSE_DURATION]))

    @action(names.ENGAGE, state=ScopeState.COARSE_MOTOR)
    def engage(self) -> None:
        """The auto approach."""
        self._ask.call("action", APPROACH)

    def command(self, text: str) -> None:
        """One of GXSM's actions, e.g. "DSP_CMD_STOPALL"."""
        self._ask.call("action", text)


__all__ = ["AfspmError", "Gxsm", "GxsmError"]
