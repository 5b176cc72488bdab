"""Driver of Asylum Research microscopes, over ZeroMQ-XOP in Igor Pro. See the README in this folder.

**Theory of operation.** Each request calls one Igor function (`xop`, `link`), and Igor answers when it is idle. The
state is polled from two sources, ARGetStatus and the values behind the panels (`session`).

    inputs        replies, matched by their id; new .ibw files in Asylum's data folder
    state         the running and the ended measurement, the frame of the open image (origin of spots), whether a scan
                  has moved the tip: all persistent (`activity`)
    outputs       calls of Asylum's functions and of `afspm.ipf`; scans and force curves from files (`result_files`)
    invariants    one request is pending at a time; a reply without a result (NaN) is neither success nor failure: the
                  state decides; all dependent values of a frame are set together, since PV updates none of them; a
                  scan runs once (LastScan)
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Final

from afspm.basics import ConfigError, Duration, PollPeriod, Refused
from afspm.driver import (
    FEEDBACK_ON,
    FRAME,
    POSITION,
    SCAN,
    SENSITIVITY,
    SPRING_CONSTANT,
    KeptSettings,
    ScriptedDriver,
    Value,
    VariableRoles,
    action,
    frame,
    refuse_value,
)
from afspm.model import ControlResponse, Region, ScopeState, both_ways, names
from afspm.plugins.asylum.activity import FORCE, AsylumActivity
from afspm.plugins.asylum.link import Link
from afspm.plugins.asylum.result_files import AsylumFiles
from afspm.plugins.asylum.session import Session
from afspm.plugins.asylum.settings import NAMES, FeedbackSwitch, FrameSettings, TipPlace
from afspm.plugins.asylum.xop import BadReply, XopError

_LAST_SCAN: Final = "LastScan"
_AMPLITUDE: Final = "AmplitudeSetpointVolts"
_AT_FIRST: Final[dict[str, Value]] = {
    names.SCAN_DIRECTION: names.UP,
    names.SPEC_KIND: FORCE,
    names.PULSE_VOLTAGE: 4.0,
    names.PULSE_DURATION: 0.1,
}
_SPOTS: Final = ("image", "scanner", "none")
_NAME: Final = "[A-Za-z][A-Za-z0-9_]{0,16}"
"""Form of the base names that Asylum takes; Asylum appends a number of four digits."""
_CHANNELS: Final = both_ways(
    {
        "height": ["Height"],
        "current": ["Current"],
        "amplitude": ["Amplitude", "Amplitude1"],
        "phase": ["Phase", "Phase1"],
        "deflection": ["Deflection"],
        "frequency shift": ["Frequency"],
        "friction": ["Lateral"],
        "potential": ["Potential"],
        "other": ["ZSensor", "Amplitude2", "Phase2", "UserIn0", "UserIn1", "UserIn2"],
    },
    "{}Trace",
    "{}Retrace",
)


_VARIABLES: Final = VariableRoles.declared(
    {
        "height": ["ZSnsr", "Raw"],
        "current": ["Cur"],
        "deflection": ["Defl", "DeflV"],
        "amplitude": ["Amp"],
        "phase": ["Phas", "Phase"],
        "frequency shift": ["Freq"],
        "time": ["Time"],
    },
    towards=["ZSnsr", "Raw"],
    states=[SPRING_CONSTANT, SENSITIVITY],
)
"""Both ways are in the same columns, the approach first. Igor's files have the deflection, and no force."""


class Asylum(ScriptedDriver[Session, AsylumActivity]):
    """The microscope behind Asylum Research's software.

    Args:
        address: the endpoint passed to `zeromq_server_bind` in Igor.
        folders: Igor's folder prefixes, "C:Users:Me:", mapped to mount points on this computer. Default: Asylum runs on
            this computer.
        base_name: base name of the files that Asylum saves. Default: the name set on Asylum's panel.
        spots: origin of SpotX and SpotY: "image" is the lower left corner of the last image, along its axes; "scanner"
            is the middle of the scanner; "none" disables moving the tip.
        move_s: longest duration of a move to a spot, experiment time. Asylum does not report the end of a move.
        reply_timeout_s: longest wait for a reply of Igor, and for the feedback to reach a new state, real time.
        poll_period_s, common: settings of every driver.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    translated = (*NAMES, *POSITION, *_AT_FIRST, FEEDBACK_ON, names.ENGAGED, names.CONTROLLER)
    channel_roles = _CHANNELS
    variable_roles = _VARIABLES
    maker: ClassVar[str] = "Oxford Instruments Asylum Research"
    software: ClassVar[str] = "Asylum Research in Igor Pro"
    counts_clockwise: ClassVar[bool] = True
    bias_reference = "tip"  # (! tip-voltage)
    program: ClassVar[str] = "Igor"
    max_pixels: ClassVar[int] = 8192 * 8192
    program_s: ClassVar[float] = 2.0
    never_shows: ClassVar = {
        "another one begun": "a stop and a start between two looks seem one scan, if none shows the tip in the air",
        "start in the file": "a note has the time of saving; the start follows from the line rate",
    }
    start_engages: ClassVar[bool] = True
    shadow: ClassVar[str] = "afspm.plugins.asylum.shadow.AsylumShadow"
    link: ClassVar[type[Link]] = Link

    def __init__(
        self,
        *,
        address: str = "tcp://127.0.0.1:5555",
        folders: Mapping[str, str] | None = None,
        base_name: str = "",
        spots: str = "image",
        move_s: Duration = 2.0,
        reply_timeout_s: Duration = 5.0,
        poll_period_s: PollPeriod = 0.25,
        **common: Any,
    ) -> None:
        super().__init__(poll_period_s=poll_period_s, **common)
        self.controller_at = address
        self._folders = dict(folders or {})
        self._base_name = _checked_name(base_name)
        self._spots = spots
        if spots not in _SPOTS:
            raise ConfigError(f"{spots!r} is no origin of spots", where="spots", hint=" or ".join(_SPOTS))
        if spots == "none":
            self.table = self.table.without(POSITION)
        self._whole_table = self.table
        self._reply_timeout_s = reply_timeout_s
        self._kept = KeptSettings(_AT_FIRST)
        image = (lambda: self.activity.image) if spots == "image" else None
        self._place = TipPlace(self.session, image, lambda: self.activity.moves(move_s))
        frame_settings = FrameSettings(self.session, lambda: self.in_force(NAMES), self._see_frame)
        feedback = FeedbackSwitch(self.session, lambda holds: self.wait_for(holds, reply_timeout_s))
        self.groups = (self._kept, frame_settings, self._place, feedback)

    @classmethod
    def technique(cls, settings: Mapping[str, object]) -> str:
        return "AFM"

    def connect(self) -> None:
        self.close()
        self._session = session = Session(self.link(self.controller_at, self._reply_timeout_s, self.clock.monotonic_s))
        self.prove()
        self._kept.kept_in(self.memory)
        self._files = AsylumFiles(self.memory, self.log)
        self._activity = AsylumActivity(
            session,
            self._files,
            self.memory,
            self._folders,
            self._frame_in_force,
            self.clock,
            self.log,
            spot_m=None if self._spots == "none" else self._place.xy_m,
            take_curve=self._take_curve,
        )
        session.doing()
        self.table = self._whole_table
        try:
            session.values([self.table[names.SAMPLE_BIAS].vendor])
        except Refused as refused:
            self.log.warning("the bias of the sample is neither set nor watched: %s", refused.reason)
            self.table = self.table.without([names.SAMPLE_BIAS])
        if not session.at_once:
            self.log.warning(
                "Igor does not include afspm.ipf: values are read one by one, and the feedback can't be switched"
            )
        for what in (SCAN, FORCE):
            self.activity.folder(what)
        if self._spots != "none":
            session.do("InitProbePos")
            self.activity.find_image()
        if self._base_name and session.text("GetBaseName") != self._base_name:
            self.activity.call_files(self._base_name)

    def close(self) -> None:
        # the activity stays: the way of the tip, and why it was withdrawn, are asked while Igor is away
        if self._session is not None:
            self._session.close()
            self._session = None

    def _frame_in_force(self) -> Region:
        return frame(self.in_force(FRAME))[0]

    def _see_frame(self, region: Region) -> None:
        # read for the first time before the activity exists
        if self._activity is not None:
            self._activity.see_frame(region)

    def next_change_s(self) -> float | None:
        return self.activity.way.next_s

    def get(self, vendor: str) -> Value:
        if vendor == names.ENGAGED:
            return self.session().doing().engaged
        try:
            if vendor == names.CONTROLLER:
                return self.session().controller()
            if any(row.vendor == vendor and row.type == "text" for row in self.table.values()):
                return self.session().text("GS", vendor)
        except BadReply as error:
            raise Refused(ControlResponse.PARAM_ERROR, str(error)) from error
        return self.session().values([vendor])[vendor]

    def refuse_unreachable(self, values: Mapping[str, Value], before: Mapping[str, Value]) -> None:
        setpoint = values.get(names.ZCTRL_SETPOINT)
        is_amplitude = self.table[names.ZCTRL_SETPOINT].vendor == _AMPLITUDE
        if is_amplitude and setpoint is not None and float(setpoint) <= 0.0:
            # PV takes it: the feedback would press the cantilever until it oscillates no more, and further
            raise refuse_value(names.ZCTRL_SETPOINT, f"an amplitude is above 0 V, not {float(setpoint):g} V")

    def is_read_alone(self, name: str) -> bool:
        return self.table[name].type == "text" or name == names.ENGAGED

    def withdrew_tip(self) -> str:
        return self.activity.withdrew_tip

    # --- actions ---

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        """Scan the frame once, in the direction `x-scan-direction`."""
        self.activity.saves(SCAN)
        # with LastScan 0 Asylum scans the frame again and again
        self.session().put({_LAST_SCAN: 1})
        if not self.session().values([_LAST_SCAN])[_LAST_SCAN]:
            why = (
                "LastScan stays 0, although it was set: Asylum would scan the frame again and again. Set it to 1 there"
            )
            raise Refused(ControlResponse.ACTION_ERROR, why)
        # before the start: the spot still counts from the corner of the image that the scan will replace
        probe_m = self._place.xy_m() if self._spots == "image" else None
        self.activity.begin(SCAN)
        up = self._kept[names.SCAN_DIRECTION] == names.UP
        self._begin(SCAN, "DoScanFunc", "UpScan" if up else "DownScan")
        self.session().put({_LAST_SCAN: 1})  # again, in case the start has reset it
        if not self.session().values([_LAST_SCAN])[_LAST_SCAN]:
            self.log.error(
                "the scan runs, but LastScan is 0: Asylum scans the frame again and again. Set it to 1 there"
            )
        self.activity.await_begin(SCAN)
        # spots count from the corner of the new image now: the same position is another spot
        if probe_m is not None:
            try:
                self._place.put(probe_m)
            except (XopError, Refused) as error:
                self.log.error("the scan runs, but the spot could not be put back: %s", error)

    def _begin(self, what: str, function: str, button: str) -> None:
        try:
            accepted = self.session().do(function, button)
        except XopError:
            # if the measurement has started all the same, the next poll registers its start
            self.activity.forget()
            raise
        if not accepted:
            raise self.activity.refuse(what)

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        """Stop the scan. Asylum also withdraws the tip."""
        self.activity.withdraw()
        # a warning, since a withdrawn tip may surprise the user: StopScan stops more than the scan
        self.log.warning("Asylum withdrew the tip, as it does whenever a scan is stopped")

    @action(names.START_SPEC)
    def start_spec(self) -> None:
        """Take a force curve at the target spot of the tip; without a target, at the tip's present position.

        Raises:
            Refused: ACTION_ERROR: Igor lacks ARGetStatus, the folder does not exist, or Asylum refuses a curve at the
                present position.
        """
        # ScanStatus and FMapStatus do not show single force curves
        if self.session().doing().bits is None:
            reason = "Igor lacks ARGetStatus, without which the end of a force curve can't be detected"
            raise Refused(ControlResponse.ACTION_ERROR, reason)
        self.activity.saves(FORCE)
        if self.activity.was_led_away:
            self._place.go()
            self.activity.curve_awaited = FORCE
        else:
            self._take_curve()

    def _take_curve(self) -> None:
        self.activity.begin_curve()
        self._begin(FORCE, "DoForceFunc", "Single")
        self.activity.await_begin(FORCE)

    @action(names.STOP_SPEC)
    def stop_spec(self) -> None:
        self.session().do("DoForceFunc", "Reset")
        self.activity.stopped()

    @action(names.RETRACT, state=ScopeState.COARSE_MOTOR)
    def retract(self) -> None:
        """Stop scan, force curve and feedback, and withdraw the tip."""
        self.activity.withdraw()

    @action(names.ENGAGE, state=ScopeState.COARSE_MOTOR)
    def engage(self) -> None:
        """Approach the sample, like the button Engage."""
        self.activity.withdrew_tip = ""
        # the function takes the name of the pressed button
        if not self.session().do("SimpleEngageMe", "SimpleEngageButton"):
            raise Refused(ControlResponse.ACTION_ERROR, "Asylum refused to engage")

    @action(names.PULSE, state=ScopeState.BUSY_PARAM)
    def pulse(self) -> None:
        self.pulse_bias()

    def command(self, text: str) -> None:
        """Call an Igor function with arguments as JSON: `DoScanFunc "DownScan"`, `PV "SaveImage", 2`."""
        name, _, arguments = text.strip().partition(" ")
        try:
            parameters = json.loads(f"[{arguments}]")
        except ValueError as error:
            reason = f'{text!r}: arguments as in JSON, PV "SaveImage", 2: {error}'
            raise Refused(ControlResponse.ACTION_ERROR, reason) from error
        if not self.session().do(name, *parameters):
            raise Refused(ControlResponse.ACTION_ERROR, f"Asylum refused {name} (it returned 1)")


def _checked_name(name: str) -> str:
    fits = not name or (re.fullmatch(_NAME, name) and "mask" not in name.lower())
    if not fits:
        hint = 'up to 17 letters, digits and "_", beginning with a letter, without "Mask"'
        raise ConfigError(f"Asylum does not take {name!r}", where="base_name", hint=hint)
    return name
