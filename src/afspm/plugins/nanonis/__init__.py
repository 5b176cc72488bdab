"""Driver of Nanonis controllers (SPECS), over their TCP programming interface. See the README in this folder.

**Theory of operation.** The first connection carries quick requests. The second connection carries blocking calls,
one at a time and in a separate thread (`session`): the wait for the end of a scan, or a spectrum with its data. Nanonis
sends nothing unrequested.

    inputs        replies, decoded by the fields of the software's release (`protocol`); events of the second
                  connection; new files in the session folder
    state         the running and the ended measurement, and the end of a pulse or tip shaping, all persistent
                  (`result_files`, `activity`); the target of the tip, not persistent (`geometry`)
    outputs       requests; scans and spectra from files (`result_files`), or from Nanonis' memory (`fetched`)
    invariants    a reply that does not fit its request ends the connection; a value of a getter is converted before
                  it goes into a setter, since both count differently; a scan that Nanonis never reported as running
                  is published only from a file, because Nanonis' memory may still hold the previous scan
"""

from __future__ import annotations

import codecs
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final, cast

from afspm.basics import ConfigError, Current, Duration, FileError, Refused, Voltage
from afspm.driver import (
    FRAME,
    SCAN,
    CoarseMove,
    ControllerLost,
    Driver,
    Entry,
    KeptSettings,
    ParameterSpec,
    Stated,
    Value,
    VariableRoles,
    action,
    as_region,
    connected,
    frame,
)
from afspm.model import ControlResponse, Scan, ScanLines, ScopeState, ScopeStatus, Spectrum, both_ways, names
from afspm.plugins.nanonis import fetched, geometry, parameter_groups, protocol, z_controller
from afspm.plugins.nanonis.activity import SAFE_TIP, WITHDRAWING, NanonisActivity
from afspm.plugins.nanonis.experiment_functions import (
    FunctionCall,
    ValueFunctions,
    check_row,
    move_of_motor,
    values_commanded,
)
from afspm.plugins.nanonis.preamplifier import Preamplifier
from afspm.plugins.nanonis.result_files import NanonisFiles
from afspm.plugins.nanonis.session import MODULES, Link, Ports, Session, WithdrawalPort
from afspm.plugins.nanonis.tip_shaper import TipShaper

_ADDRESS: Final = "127.0.0.1:6501,6502"
_NO_WAY: Final = (
    "no port is kept for withdrawing the tip: while the first port of Nanonis stays silent, the tip stays where it is; "
    'name a third one, as in address = "127.0.0.1:6501,6502,6503"'
)
_AT_FIRST: Final[dict[str, Value]] = {
    names.SCAN_DIRECTION: names.UP,
    names.SPEC_KIND: "IV",
    names.PULSE_VOLTAGE: 4.0,
    names.PULSE_DURATION: 0.1,
    names.CRASH_SPEED: 10e-9,
    names.CRASH_DEPTH: 1e-9,
}
_CONTINUOUS: Final = (
    "the continuous scan stays on at Nanonis' panel (Scan Control), although it was switched off: one scan would "
    "follow the other without end. Switch it off there"
)
_GRAB_SHARE: Final = 10.0
"""Real time without a grab of lines, in times of the last grab: large scans must not fill the connection."""
_UNSAVED: Final = (
    "scans are not saved, although saving was switched on (Scan Control): their data is fetched from Nanonis' memory"
)
_AT_ONCE: Final = 0
"""Argument of functions that could also wait for the end of their action."""
_NO_TIMEOUT: Final = -1
_LATE_S: Final = 1.0
"""Time beyond the duration of a pulse or tip shaping, experiment time: a real Nanonis begins up to 0.33 s late, moves
the tip up to 0.5 s later, and its preamplifier needs up to 0.45 s to leave saturation; it reports no end."""
_APPROACH_SHOWS_S: Final = 3.0
_SIDE: Final = (
    parameter_groups.ScanSpeed,
    parameter_groups.Gains,
    parameter_groups.MoveSpeed,
    parameter_groups.Slope,
    parameter_groups.DriftRate,
    parameter_groups.SafeTip,
    parameter_groups.SweptBias,
    parameter_groups.SweptHeight,
    parameter_groups.LockIn,
)
_SETPOINT: Final = "ZCtrl.Setpnt"
_GROUPS: Final = (
    geometry.ScanFrame,
    *_SIDE,
    parameter_groups.CurvePoints,
    parameter_groups.CurveTiming,
    geometry.Probe,
    parameter_groups.FeedbackOn,
    parameter_groups.TipState,
)
_TRANSLATED: Final = tuple(name for group in _GROUPS for name in group.names)
_CHANNELS: Final = both_ways(
    {
        "height": ["Z"],
        "current": ["Current"],
        "amplitude": ["Amplitude", "OC_D1_Amplitude", "OC_M1_Amplitude"],
        "phase": ["Phase", "OC_D1_Phase", "OC_M1_Phase"],
        "frequency shift": ["OC_M1_Freq._Shift", "Frequency_Shift"],
        "excitation": ["Excitation", "OC_M1_Excitation"],
        "other": ["Bias", "LI_Demod_1_X", "LI_Demod_1_Y", "LI_Demod_2_X", "LI_Demod_2_Y"],
    },
    "{} Forward",
    "{} Backward",
)


_SIGNALS: Final = {
    "current": ["Current"],
    "conductance": ["dI/dV"],
    "force": ["Force"],
    "deflection": ["Deflection"],
    "frequency shift": ["Frequency Shift", "OC M1 Freq. Shift"],
    "amplitude": ["Amplitude", "OC M1 Amplitude", "OC D1 Amplitude"],
    "phase": ["Phase", "OC M1 Phase", "OC D1 Phase"],
    "excitation": ["Excitation", "OC M1 Excitation"],
}
_AVERAGE: Final = " [AVG]"
"""Nanonis adds it to the names of signals where it saves single sweeps, too; their average then has the role."""
_BACK: Final = (" [bwd]", f"{_AVERAGE} [bwd]", f" [bwd]{_AVERAGE}")
_VARIABLES: Final = VariableRoles.declared(
    {
        "bias": ["Bias calc", "Bias", f"Bias{_AVERAGE}"],
        "height": ["Z rel", "Z", f"Z{_AVERAGE}"],
        **{role: [*those, *(name + _AVERAGE for name in those)] for role, those in _SIGNALS.items()},
        **{
            f"{role}, retrace": [
                f"{name}{way}" for way in (" [bwd]", f"{_AVERAGE} [bwd]", f" [bwd]{_AVERAGE}") for name in those
            ]
            for role, those in _SIGNALS.items()
        },
    }
)


class Nanonis(Driver):
    """The driver of a microscope with a Nanonis controller.

    Args:
        address: "host:port,port,port": ports at File > Settings Options > TCP Programming Interface; each serves one
            client: for quick requests, for calls that last, for withdrawing the tip alone, and for the data of scans or
            in place of one of the first two that stays silent. An emulator needs a single port.
        session_dir: local path of Nanonis' session folder. Default: the path that Nanonis reports. Data in unreachable
            files is fetched over TCP.
        release: release of Nanonis' software (Help > Info), if the software reports none or a wrong release.
        reply_timeout_s: longest wait for a reply, real time.
        autosave: True switches on saving of every scan; False leaves the panel's setting alone.
        grabbed_rows, grabbed_backward: see `fetched.Grabbing`.
        code_page: code page of Nanonis' computer, such as "gbk", for its texts that are not UTF-8. Without it they may
            be shown with other letters, and are sent back unchanged all the same.
        preamplifier_range: largest current of the preamplifier, if Nanonis' label of the gain does not state V/A.
        sensor: "qplus" or "other". On a qPlus sensor `x-crash` is refused at a larger bias than `qplus_bias`.
        qplus_bias: largest amount of the bias at which a qPlus sensor may touch the sample.
        common: settings of every driver.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    translated = (*_TRANSLATED, *_AT_FIRST, names.CONTROLLER)
    channel_roles = _CHANNELS
    variable_roles = _VARIABLES
    maker: ClassVar[str] = "SPECS Zurich"
    software: ClassVar[str] = "Nanonis"
    counts_clockwise: ClassVar[bool] = True
    max_pixels: ClassVar[int] = 8192 * 8192
    program_s: ClassVar[float] = 2.0
    leaves_tip_s: ClassVar[float] = 5.0
    never_shows: ClassVar = {
        "another one begun": "a stop and a start between two looks seem one scan, unless the stop saves a file",
    }
    shadow: ClassVar[str] = "afspm.plugins.nanonis.shadow.NanonisShadow"
    session_class: ClassVar[type[Session]] = Session
    activity_class: ClassVar[type[NanonisActivity]] = NanonisActivity

    def __init__(
        self,
        *,
        address: str = _ADDRESS,
        session_dir: str | None = None,
        release: int | None = None,
        reply_timeout_s: Duration = 5.0,
        autosave: bool = True,
        grabbed_rows: str = "top-first",
        grabbed_backward: str = "mirrored",
        code_page: str = "",
        preamplifier_range: Current | None = None,
        sensor: str = "",
        qplus_bias: Voltage = 0.05,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        self.controller_at = address
        self._ports = Ports(_addresses(address))
        self._withdrawal: WithdrawalPort | None = None
        self._session_dir = None if session_dir is None else Path(session_dir)
        self._release = release
        self._reply_timeout_s = reply_timeout_s
        self._autosave = autosave
        self._grabbing = fetched.Grabbing(grabbed_rows, grabbed_backward)
        self._code_page = _code_page(code_page)
        self._session: Session | None = None
        self._grabs_at_s = 0.0
        self._left_out: set[str] = set()
        self._is_unknown_saving = False
        self._kept = KeptSettings(_AT_FIRST)
        ask = self._ask
        self._probe = geometry.Probe(ask, lambda: self.clock.now_s(), self._awaits_scan)
        feedback = parameter_groups.FeedbackOn(ask, lambda holds: self.wait_for(holds, reply_timeout_s))
        self._tip = parameter_groups.TipState(ask, lambda: self.log)
        self._points = parameter_groups.CurvePoints(ask, self._module)
        alone = (*(group(ask) for group in _SIDE), self._points, parameter_groups.CurveTiming(ask, self._module))
        side = [parameter_groups.SideGroup(group, lambda: self.log) for group in alone]
        self._timing = side[-1]
        self.groups = (geometry.ScanFrame(ask), *side[:3], self._probe, feedback, self._tip, self._kept, *side[3:])
        self._preamplifier = Preamplifier(ask, preamplifier_range)
        self._tip_shaper = TipShaper(ask, sensor, qplus_bias, lambda: self.log)
        self._files: NanonisFiles

    def connect(self) -> None:
        self._close_session()
        self._probe.forget()
        if self._ports.named != (named := _addresses(self.controller_at)):
            self._ports = Ports(named)
        if self._withdrawal is None and self.withdraws_aside:
            self._withdrawal = WithdrawalPort(self._link_to_withdraw, self.clock.monotonic_s, self.log)
        if self._withdrawal is not None:
            self._withdrawal.hold()
        session = self._session = self.session_class(
            self, self._ports, self._reply_timeout_s, self._release, self._code_page
        )
        if not hasattr(self, "_files"):
            self._kept.kept_in(self.memory)
            own_folder = (self.run_dir / "scans").resolve()
            patience_s = self.patience_s(self.common.result_timeout_s / 2)
            self._files = NanonisFiles(self.memory, self._session_dir, own_folder, patience_s, self.log)
        self._activity = self.activity_class(
            session, self._files, self._probe, self._tip, self.memory, self.clock, self.log
        )
        z_controller.compare(session.ask, self.table[names.ZCTRL_SETPOINT].unit, self.log)
        self._probe.look(self.log)
        if self._holds_current:
            self._preamplifier.look(self.log)
        reported = str(session.ask("Util.SessionPathGet")[0])
        self.identity = f"session folder {reported} of Nanonis"
        folder = self._session_dir or Path(reported)
        if not folder.is_dir():
            self.log.warning(
                "the session folder %s does not exist on this computer: data is fetched over TCP (or set session_dir)",
                folder,
            )
        self._files.look(folder)

    def _module(self) -> str:
        return MODULES[str(self._kept[names.SPEC_KIND])]

    def _awaits_scan(self) -> bool:
        # it may move the tip before Nanonis shows it as running
        return hasattr(self, "_files") and self._files.what == SCAN and not self._files.was_seen

    def close(self) -> None:
        self._close_session()
        if self._withdrawal is not None:
            self._withdrawal.close()

    def _close_session(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None

    @property
    def withdraws_aside(self) -> bool:
        return not self.only_reads and Ports(_addresses(self.controller_at)).for_withdrawing is not None

    def withdraw_elsewhere(self) -> bool:
        if self._withdrawal is None:
            return False
        self._withdrawal.withdraw()
        return True

    def _link_to_withdraw(self, timeout_s: float) -> Link:
        address = self._ports.for_withdrawing
        assert address is not None
        link = self.session_class.link(address, timeout_s, self.clock.monotonic_s)
        self.prove()
        return link

    @classmethod
    def lost_without(cls, settings: Mapping[str, object]) -> Sequence[str]:
        address = str(settings.get("address", _ADDRESS))
        return () if Ports(_addresses(address)).for_withdrawing else (_NO_WAY,)

    @property
    def _there(self) -> Session:
        return connected(self._session, "Nanonis")

    def _ask(self, name: str, *arguments: object, longer_s: float = 0.0) -> tuple[object, ...]:
        return self._there.ask(name, *arguments, longer_s=longer_s)

    def status(self) -> ScopeStatus:
        if self._withdrawal is not None:
            self._withdrawal.hold()
        return self._activity.status()

    def next_change_s(self) -> float | None:
        return self._activity.next_change_s()

    def reports_end(self) -> bool:
        return self._session is not None and self._activity.reports_end()

    def same(self, name: str, a: Value, b: Value, among: Mapping[str, Value]) -> bool:
        return super().same(name, a, b, among) or geometry.same_float32(name, a, b, among)

    def reach(self) -> Mapping[str, ParameterSpec]:
        return self._probe.within(super().reach())

    @property
    def _holds_current(self) -> bool:
        return self.table[names.ZCTRL_SETPOINT].si_unit == "A"

    def refuse_unreachable(self, values: Mapping[str, Value], before: Mapping[str, Value]) -> None:
        setpoint = values.get(names.ZCTRL_SETPOINT)
        if values.get(names.FEEDBACK_ON):
            self._refuse_setpoint()
        if setpoint is None or not self._holds_current:
            return
        if not self.same(names.ZCTRL_SETPOINT, before[names.ZCTRL_SETPOINT], setpoint, before):
            self._preamplifier.refuse_beyond(float(setpoint))

    def _refuse_setpoint(self) -> None:
        # right before the feedback acts on it: a person may have chosen another gain since it was set
        if self._holds_current:
            self._preamplifier.refuse_beyond(float(self.in_force([names.ZCTRL_SETPOINT])[names.ZCTRL_SETPOINT]))

    def get(self, vendor: str) -> Value:
        """Return a value by the name of its functions, see `ValueFunctions`: "Bias." means Bias.Get."""
        if vendor == names.CONTROLLER:
            return self._there.controller
        of = ValueFunctions.of(vendor)

        def ask(name: str, *keys: object) -> tuple[Any, ...]:
            return self._ask(name, *keys)[of.place : of.place + 1]  # another value may be infinite

        try:
            (value,) = parameter_groups.numbers(ask, of.getter, *of.keys)
        except protocol.UnreadableReply as error:
            if vendor == _SETPOINT:  # the feedback acts on it
                raise
            raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, f"Nanonis' answer can't be read: {error}") from error
        return cast(Value, value)

    def write(self, values: Mapping[str, Value]) -> None:
        try:
            super().write(values)
        except protocol.UnreadableReply as error:  # a vital value ends the contact when it is read
            reason = f"{', '.join(values)}: Nanonis' answer can't be read: {error}"
            raise Refused(ControlResponse.PARAM_ERROR, reason) from error

    def set(self, values: Mapping[str, Value]) -> None:
        for vendor, value in values.items():
            of = ValueFunctions.of(vendor)
            present = self._ask(of.getter, *of.keys) if of.is_one_of_several else (value,)
            self._ask(of.setter, *of.arguments(value, present))

    # --- results ---

    def results(self) -> Sequence[str]:
        if self._tip.is_undecided:
            return self._files.listed()  # a measurement that ends meanwhile may be one in the air
        return self._files.results(self.clock.now_s(), self._fetch)

    def followed(self) -> bool | None:
        return self._files.followed()

    def stopped_by_hand(self) -> str:
        return self._activity.stopped_by_hand()

    def withdrew_tip(self) -> str:
        # who withdraws it shows only at the end
        return SAFE_TIP if self._tip.is_safe else WITHDRAWING if self._tip.is_undecided else ""

    def stated(self, result: str) -> Stated:
        return self._files.stated(result)

    def current_a(self) -> float | None:
        try:
            return float(parameter_groups.numbers(self._ask, "Current.Get")[0])
        except (protocol.NanonisError, protocol.UnreadableReply):
            return None

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        return self._files.load(result)

    def _fetch(self, ended: Entry) -> Sequence[Scan | Spectrum]:
        if ended["what"] == SCAN:
            found = self._images()
            scans = [Scan(as_region(ended["frame"]), image.name, image.unit, image.values) for image in found]
            return list(map(self.channels.shown, scans))
        curve, self._activity.curve = self._activity.curve, None
        if curve is None:
            raise FileError("its data was not requested from Nanonis")
        taken = fetched.spectrum(curve, ended["what"], (ended["position"][0], ended["position"][1]))
        return [self.channels.shown(taken)]

    def lines(self, start: int) -> Sequence[ScanLines]:
        """Return new lines from Nanonis' memory, in which lines not yet scanned are NaN."""
        # not the frame in force, which a person may have changed for the next scan
        kept = self._files.frame
        if kept is None or not self._files.was_seen:
            return ()  # the memory may still hold the previous scan, all of whose lines would be new
        began_s = self.clock.monotonic_s()
        if began_s < self._grabs_at_s:
            return ()
        new = fetched.new_lines(self._images(), as_region(kept), start)
        ended_s = self.clock.monotonic_s()
        self._grabs_at_s = ended_s + _GRAB_SHARE * (ended_s - began_s)
        return new

    def _images(self) -> list[fetched.Image]:
        try:
            return fetched.images(self._there.ask_for_data, self._grabbing, self._leave_out)
        except protocol.UnreadableReply as error:
            raise FileError(f"the scan in Nanonis' memory can't be read: {error}") from error

    def _leave_out(self, channel: str, error: protocol.UnreadableReply) -> None:
        if channel not in self._left_out:  # lines are fetched once a second
            self._left_out.add(channel)
            self.log.warning(
                "the channel %s is chosen in Nanonis' Scan Control, and can't be read from its memory, as one that is "
                "not recorded: it is left out of lines, and of scans without a file (%s)",
                channel,
                error,
            )

    # --- actions ---

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        """Scan the frame once, in the direction `x-scan-direction`."""
        self._activity.refuse_safe_tip()
        self._prepare_panel()
        self._activity.begin_scan(frame(self.in_force(FRAME))[0])
        start = 0
        try:
            self._ask("Scan.Action", start, int(self._kept[names.SCAN_DIRECTION] == names.UP))
        except protocol.NanonisError:
            self._activity.forget()
            raise
        if self._ask("Scan.StatusGet")[0]:  # the scan may be over before the next poll
            self._files.seen()

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        self._activity.stop_scan()

    @action(names.START_SPEC)
    def start_spec(self) -> None:
        """Take a spectrum of the kind `x-spec-kind` at the tip's position."""
        self._activity.refuse_safe_tip()
        kind = str(self._kept[names.SPEC_KIND])
        if not self._there.listener.is_there:
            reason = "no port of Nanonis is left for a second connection, which a spectrum needs"
            raise Refused(ControlResponse.ACTION_ERROR, reason)
        if MODULES[kind] not in self._there.opened:
            raise Refused(ControlResponse.ACTION_ERROR, f"Nanonis can't open the module {MODULES[kind]}")
        if self._timing.unreadable:  # a limit of the height would take the offset for none
            reason = f"Nanonis' answer on the height of curves can't be read: {self._timing.unreadable}"
            raise Refused(ControlResponse.ACTION_ERROR, reason)
        self._activity.start_curve(kind, is_saved=self._saves_curves())

    @action(names.STOP_SPEC)
    def stop_spec(self) -> None:
        self._activity.stop_curve()

    @action(names.PULSE, state=ScopeState.BUSY_PARAM)
    def pulse(self) -> None:
        """Pulse the bias to `x-pulse-voltage` for `x-pulse-duration`, with the z controller on hold."""
        duration_s = self._kept.number(names.PULSE_DURATION)
        hold, absolute = 1, 2
        with self._activity.occupied(ScopeState.BUSY_PARAM, duration_s + _LATE_S):
            pulse = (_AT_ONCE, duration_s, self._kept.number(names.PULSE_VOLTAGE), hold, absolute)
            self._ask("Bias.Pulse", *pulse, longer_s=duration_s)  # others report releases that answer at its end

    @action(names.CRASH, state=ScopeState.MOVING)
    def crash(self) -> None:
        """Shape the tip: `x-crash-depth` down at `x-crash-speed` and back; the z controller is restored."""
        self._activity.refuse_safe_tip()
        depth_m, speed_m_s = self._kept.number(names.CRASH_DEPTH), self._kept.number(names.CRASH_SPEED)
        lasts_s = self._tip_shaper.prepare(depth_m, speed_m_s)
        with self._activity.occupied(ScopeState.MOVING, lasts_s + _LATE_S):
            self._ask("TipShaper.Start", _AT_ONCE, _NO_TIMEOUT, longer_s=lasts_s)

    @action(names.RETRACT, state=ScopeState.COARSE_MOTOR)
    def retract(self) -> None:
        """Withdraw the tip by its piezo, even if the running measurement can't be stopped."""
        if self._session is None or not hasattr(self, "_activity"):
            raise ControllerLost("Nanonis was not reached yet", where=self.controller_at)
        # the approach first: a running approach would bring the withdrawn tip back
        for stop in (self._activity.stop_approach, self._activity.stop_measuring):
            try:
                stop()
            except (protocol.NanonisError, protocol.UnreadableReply) as error:
                self.log.error("the measurement can't be stopped: %s; the tip is withdrawn all the same", error)
        self._ask("ZCtrl.Withdraw", _AT_ONCE, _NO_TIMEOUT)

    @action(names.ENGAGE, state=ScopeState.COARSE_MOTOR)
    def engage(self) -> None:
        """Switch the z controller on; this also brings back a tip withdrawn by `x-retract` or the safe tip."""
        self._refuse_setpoint()
        on = 1
        self._ask("ZCtrl.OnOffSet", on)

    @action(names.APPROACH, state=ScopeState.COARSE_MOTOR)
    def approach(self) -> None:
        """Start the *Auto Approach*, as set in its panel; `x-retract` stops it."""
        self._refuse_setpoint()
        on = 1
        # its status reads off for a moment after the start, as others report
        with self._activity.occupied(ScopeState.COARSE_MOTOR, _APPROACH_SHOWS_S):
            self._ask("AutoApproach.OnOffSet", on)

    def move_z(self, z_m: float) -> None:
        self._ask("ZCtrl.ZPosSet", z_m)

    def command(self, text: str) -> None:
        """Call a function with its arguments, e.g. "AutoApproach.OnOffSet 1"."""
        call = FunctionCall.of(text)
        self._ask(call.name, *call.arguments)

    @classmethod
    def commanded(cls, action: Mapping[str, object]) -> Sequence[tuple[str, Value]]:
        return values_commanded(action)

    @classmethod
    def coarse_move(cls, action: Mapping[str, object]) -> CoarseMove | None:
        return move_of_motor(action)

    @classmethod
    def check_row(cls, row: ParameterSpec) -> None:
        check_row(row)

    def _saves_curves(self) -> bool:
        why = "its answer has no autosave"
        try:
            saves = self._points.save(switch_on=self._autosave)
        except (protocol.NanonisError, protocol.UnreadableReply) as error:
            saves, why = None, str(error)
        if saves is None and not self._is_unknown_saving:
            self._is_unknown_saving = True
            self.log.warning("Nanonis does not report whether it saves curves, so each waits for its file: %s", why)
        if saves is False and self._autosave:
            self.log.warning("curves are not saved, although saving was switched on: their data comes over TCP")
        return saves is not False

    def _prepare_panel(self) -> None:
        # Set only if the panel differs: one scan, not continuous, saved. PropsGet and PropsSet count differently (in
        # Get, autosave 0 is "all"; in Set, 0 is "no change"), so no value of Get is passed to Set unchanged.
        try:
            continuous, bouncy, autosave, series, comment, *rest = self._ask("Scan.PropsGet")
        except protocol.UnreadableReply as error:
            reason = f"it is not known whether the scan would end (*continuous*): {error}"
            raise Refused(ControlResponse.ACTION_ERROR, reason) from error
        save = self._autosave and autosave != 0
        if continuous or bouncy or save:
            no_change, off, save_all = 0, 2, 1
            modules = rest[0] if rest else []
            autosave = save_all if save else no_change
            self._ask("Scan.PropsSet", off, off, autosave, series, comment, modules, no_change)
            # another program or the panel may switch it on again, and a reply of PropsSet is no proof
            continuous, _, autosave, *_ = self._ask("Scan.PropsGet")
            if continuous:
                raise Refused(ControlResponse.ACTION_ERROR, _CONTINUOUS)
            if save and autosave != 0:
                self.log.warning(_UNSAVED)


def _code_page(name: str) -> str:
    try:
        codecs.lookup(name or "utf-8")
    except LookupError:
        raise ConfigError(f"{name!r} is no code page", where="code_page", hint='such as "gbk" or "cp1252"') from None
    return name


def _addresses(text: str) -> list[tuple[str, int]]:
    host, _, ports = text.rpartition(":")
    try:
        found = [(host, int(port)) for port in ports.split(",") if host]
    except ValueError:
        found = []
    if not found:
        raise ConfigError(f"{text!r} is not an address", where="address", hint='"host:port,port,port"')
    return found
