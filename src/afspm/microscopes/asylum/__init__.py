"""Asylum Research, over ZeroMQ-XOP in its Igor Pro. See the README beside this."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

from afspm.errors import ConfigError, Refused
from afspm.microscopes.asylum.activity import FORCE, Activity
from afspm.microscopes.asylum.frame import GLOBALS, NAMES, asylums, from_image, generic, on_image
from afspm.microscopes.asylum.link import Link
from afspm.microscopes.asylum.result_files import AsylumFiles
from afspm.microscopes.asylum.session import Session
from afspm.microscopes.asylum.xop import XopError
from afspm.model import ControlResponse, Region, Scan, ScopeState, ScopeStatus, Spectrum, names
from afspm.translator.driver import ControllerLost, Driver, action
from afspm.translator.parameters import FEEDBACK_ON, Value
from afspm.translator.result_files import SCAN
from afspm.translator.settings import FRAME, POSITION, frame
from afspm.units import Duration

_AT_FIRST: Final[dict[str, Value]] = {
    names.SCAN_DIRECTION: names.UP,
    names.SPEC_KIND: FORCE,
    names.PULSE_VOLTAGE: 4.0,
    names.PULSE_DURATION: 0.1,
}
_SPOTS: Final = ("image", "scanner", "none")
_OUR_SPOT: Final = 1.0
_NAME: Final = "[A-Za-z][A-Za-z0-9_]{0,16}"
"""Of a wave of Igor's, with room for the number; it is a file's name, too."""


class Asylum(Driver):
    """The microscope behind Asylum Research's software.

    Args:
        address: that was given to `zeromq_server_bind`.
        folders: beginnings of Asylum's folders as Igor writes them, "C:Users:Me:", and where those are seen from
            here; without it: Asylum runs on this computer.
        base_name: of the files that Asylum saves; left out: what its panel says.
        spots: what SpotX and SpotY count from: the lower left corner of the last "image", along its axes; the middle
            of the "scanner"; "none": the tip can't be sent anywhere.
        move_s: the time that a move to a spot may take, which Asylum does not tell, in experiment time.
        reply_timeout_s: how long Igor may take to answer, in real time.
        parameters, actions, poll_period_s, result_timeout_s: as for every microscope.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    translated = (*NAMES, *POSITION, *_AT_FIRST, FEEDBACK_ON, names.ENGAGED, names.CONTROLLER)
    max_pixels: ClassVar[int] = 8192 * 8192
    program_s: ClassVar[float] = 2.0

    def __init__(
        self,
        *,
        address: str = "tcp://127.0.0.1:5555",
        folders: Mapping[str, str] | None = None,
        base_name: str = "",
        spots: str = "image",
        move_s: Duration = 2.0,
        reply_timeout_s: Duration = 5.0,
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
        actions: Mapping[str, Mapping[str, Any]] | None = None,
        poll_period_s: Duration = 0.25,
        result_timeout_s: Duration = 10.0,
    ) -> None:
        super().__init__(
            parameters=parameters,
            actions=actions,
            poll_period_s=poll_period_s,
            result_timeout_s=result_timeout_s,
        )
        self.controller_at = address
        self._folders = dict(folders or {})
        self._base_name = _checked_name(base_name)
        self._spots = spots
        if spots not in _SPOTS:
            raise ConfigError(f"{spots!r}", where="spots", hint=" or ".join(_SPOTS))
        if spots == "none":
            self.table = self.table.without(POSITION)
        self._move_s = move_s
        self._reply_timeout_s = reply_timeout_s
        self._session: Session | None = None
        self._own: dict[str, Callable[[Session], Value]] = {
            FEEDBACK_ON: Session.feedback_on,
            names.ENGAGED: lambda session: session.doing().engaged,
            names.CONTROLLER: Session.controller,
        }

    def connect(self) -> None:
        """A new connection, and what must be there for it to be of use."""
        self.close()
        link = Link(self.controller_at, self._reply_timeout_s, self.clock.monotonic_s)
        self._session = session = Session(link)
        self.prove()
        self._kept: dict[str, Any] = self.memory.setdefault("kept", {})
        self._kept |= {name: value for name, value in _AT_FIRST.items() if name not in self._kept}
        self._harvest = AsylumFiles(self.memory, self.log)
        self._activity = Activity(
            session, self._harvest, self.memory, self._folders, self._frame_in_force, self.clock, self.log
        )
        session.doing()
        if not session.at_once:
            self.log.warning("Igor has not afspm.ipf: every value is asked for by itself, feedback can't be switched")
        for what in (SCAN, FORCE):
            self._activity.folder(what)
        if self._spots != "none":
            session.do("InitProbePos")
            self._activity.find_image()
        if self._base_name and session.text("GetBaseName") != self._base_name:
            self._activity.call_files(self._base_name)

    def close(self) -> None:
        """End the connection. What was begun goes on."""
        if self._session is not None:
            self._session.close()
            self._session = None

    @property
    def _igor(self) -> Session:
        if self._session is None:
            raise ControllerLost("Igor is not connected", where=self.controller_at)
        return self._session

    def status(self) -> ScopeStatus:
        """What Asylum is doing now."""
        return self._activity.status()

    def next_change_s(self) -> float | None:
        """When a move is over."""
        return self._activity.next_change_s()

    # --- parameters ---

    def read(self, wanted: Collection[str]) -> dict[str, Value]:
        """What Asylum has."""
        found: dict[str, Value] = {name: self._kept[name] for name in wanted if name in self._kept}
        found |= {name: self._own[name](self._igor) for name in wanted if name in self._own}
        if not NAMES.isdisjoint(wanted):
            found |= generic(self._igor.values(GLOBALS))
        if not set(POSITION).isdisjoint(wanted):
            found |= zip(POSITION, self._probe_m(), strict=True)
        return found | self._read_table([name for name in wanted if name not in found])

    def write(self, values: Mapping[str, Value]) -> None:
        """What belongs together at once, the rest one by one."""
        left = dict(values)
        self._kept.update({name: left.pop(name) for name in _AT_FIRST if name in left})
        framed = {name: left.pop(name) for name in NAMES if name in left}
        if framed:
            self._write_frame(framed)
        place: dict[str, Value] = {name: left.pop(name) for name in POSITION if name in left}
        if place:
            self._send_probe(place)
        if FEEDBACK_ON in left:
            self._switch_feedback(on=bool(left.pop(FEEDBACK_ON)))
        super().write(left)

    def get(self, vendor: str) -> Value:
        """A number or a text of Asylum's, by its name."""
        if any(row.vendor == vendor and row.type == "text" for row in self.table.values()):
            return self._igor.text("GS", vendor)
        return self._igor.values([vendor])[vendor]

    def set(self, values: Mapping[str, Value]) -> None:
        """Numbers and texts of Asylum's, by their names, one after the other."""
        for vendor, value in values.items():
            self._igor.put(vendor, value)

    def _read_table(self, wanted: Sequence[str]) -> dict[str, Value]:
        numbers = [name for name in wanted if self.table[name].type != "text"]
        values = self._igor.values([self.table[name].vendor for name in numbers]) if numbers else {}
        found = {name: self.table[name].from_vendor(values[self.table[name].vendor]) for name in numbers}
        return found | super().read([name for name in wanted if name not in found])

    def _switch_feedback(self, *, on: bool) -> None:
        """If it is otherwise; until that is seen, as the tip may have a way to go."""
        if self._igor.feedback_on() is on:
            return
        if not self._igor.do("AfspmFeedback", int(on)):
            raise Refused(ControlResponse.PARAM_ERROR, "Asylum could not switch the feedback")
        until_s = self.clock.monotonic_s() + self._reply_timeout_s
        while self._igor.feedback_on() is not on and self.clock.monotonic_s() < until_s:
            pass  # each question takes as long as Igor takes to answer it

    def _frame_in_force(self) -> Region:
        return frame(self.in_force(FRAME))[0]

    def _write_frame(self, framed: Mapping[str, Value]) -> None:
        wanted = asylums(framed, self.in_force(NAMES))
        there = self._igor.values(list(wanted))
        for name, value in wanted.items():
            if there[name] != value:
                self._igor.put(name, value)

    def _probe_m(self) -> tuple[float, float]:
        spot_m = (self._igor.number("GetProbePosX"), self._igor.number("GetProbePosY"))
        return from_image(spot_m, self._activity.image) if self._spots == "image" else spot_m

    def _send_probe(self, place: Mapping[str, Value]) -> None:
        x, y = (float(place.get(name, was)) for name, was in zip(POSITION, self._probe_m(), strict=True))
        self._put_spot((x, y))
        self._go()

    def _go(self) -> None:
        self._igor.put("ForceSpotNumber", _OUR_SPOT)  # whatever is chosen at the panel
        if not self._igor.do("DoForceFunc", "Go"):
            raise Refused(ControlResponse.PARAM_ERROR, "Asylum refuses to move the tip")
        self._activity.moves(self._move_s)

    def _put_spot(self, xy_m: tuple[float, float]) -> None:
        spot_m = on_image(xy_m, self._activity.image) if self._spots == "image" else xy_m
        if not (self._igor.do("SetProbePosX", spot_m[0]) and self._igor.do("SetProbePosY", spot_m[1])):
            raise Refused(ControlResponse.PARAM_ERROR, "Asylum refuses the spot")

    # --- results ---

    def results(self) -> Sequence[str]:
        """The last files that Asylum saved."""
        return self._harvest.results(self.clock.now_ns())

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        """Read a file."""
        return self._harvest.load(result)

    # --- actions ---

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        """Scan the frame once, in the direction of `x-scan-direction`."""
        self._activity.saves(SCAN)
        probe_m = self._probe_m() if self._spots == "image" else None
        self._activity.begin(SCAN)
        up = self._kept[names.SCAN_DIRECTION] == names.UP
        self._igor.put("LastScan", 1)
        self._begin(SCAN, "DoScanFunc", "UpScan" if up else "DownScan")
        self._igor.put("LastScan", 1)  # also where beginning to scan puts it back
        self._activity.settle(SCAN)
        if probe_m is not None:  # it stays where it is, on another image
            try:
                self._put_spot(probe_m)
            except (XopError, Refused) as error:
                self.log.error("it scans, but the spot can't be put where it was: %s", error)

    def _begin(self, what: str, function: str, button: str) -> None:
        try:
            accepted = self._igor.do(function, button)
        except XopError:
            self._activity.forget()
            raise
        if not accepted:
            raise self._activity.refuse(what)

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        """Break the scan off. Asylum withdraws the tip."""
        self._igor.do("DoScanFunc", "StopScan")
        self._activity.stopped()
        self.log.warning("Asylum has withdrawn the tip, as it does with every scan that is stopped")

    @action(names.START_SPEC)
    def start_spec(self) -> None:
        """Take a force curve where the tip was sent, or else where it is."""
        if self._igor.doing().bits is None:
            reason = "without ARGetStatus it can't be seen when a force curve has ended"
            raise Refused(ControlResponse.ACTION_ERROR, reason)
        self._activity.saves(FORCE)
        if self._activity.was_led_away:
            self._go()
            self._activity.takes_on_arrival(self._take_curve)
        else:
            self._take_curve()

    def _take_curve(self) -> None:
        self._activity.begin(FORCE, None if self._spots == "none" else self._probe_m())
        self._begin(FORCE, "DoForceFunc", "Single")
        self._activity.settle(FORCE)

    @action(names.STOP_SPEC)
    def stop_spec(self) -> None:
        """Break the force curve off."""
        self._igor.do("DoForceFunc", "Reset")
        self._activity.stopped()

    @action(names.RETRACT, state=ScopeState.COARSE_MOTOR)
    def retract(self) -> None:
        """Stop whatever is going on, feedback too, and withdraw the tip."""
        self._igor.do("DoScanFunc", "StopScan")
        self._activity.stopped()

    @action(names.ENGAGE, state=ScopeState.COARSE_MOTOR)
    def engage(self) -> None:
        """Bring the tip to the sample, as the button Engage does."""
        if not self._igor.do("SimpleEngageMe", "SimpleEngageButton"):
            raise Refused(ControlResponse.ACTION_ERROR, "Asylum refuses to engage")

    @action(names.PULSE, state=ScopeState.BUSY_PARAM)
    def pulse(self) -> None:
        """A bias pulse of `x-pulse-voltage` for `x-pulse-duration`, where the tip is: the bias is set, and put back."""
        wanted = self.in_force([names.PULSE_VOLTAGE, names.PULSE_DURATION])
        self.for_a_while({names.TIP_BIAS_VOLTAGE: wanted[names.PULSE_VOLTAGE]}, float(wanted[names.PULSE_DURATION]))

    def command(self, text: str) -> None:
        """A function with its arguments as JSON: `DoScanFunc "DownScan"`, `PV "SaveImage", 2`."""
        name, _, arguments = text.strip().partition(" ")
        try:
            parameters = json.loads(f"[{arguments}]")
        except ValueError as error:
            reason = f'{text!r}: arguments as in JSON, PV "SaveImage", 2: {error}'
            raise Refused(ControlResponse.ACTION_ERROR, reason) from error
        if not self._igor.do(name, *parameters):
            raise Refused(ControlResponse.ACTION_ERROR, f"{name} gave 1, which is how Asylum's functions refuse")


def _checked_name(name: str) -> str:
    """What Asylum takes for a base name."""
    fits = not name or (re.fullmatch(_NAME, name) and "mask" not in name.lower())
    if not fits:
        hint = 'up to 17 letters, digits and "_", a letter first, no "Mask"'
        raise ConfigError(f"Asylum does not take {name!r}", where="base_name", hint=hint)
    return name
