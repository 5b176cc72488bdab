"""Targets of other instruments: set a target, and wait until the value has arrived."""

from __future__ import annotations

import math
from dataclasses import replace

from afspm import wire
from afspm.basics.errors import NoResponse
from afspm.client.command_retry import PATIENCE_S, CommandRetry, refused
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.parameter_text import Value, value_in
from afspm.model import ControlRequest, ControlResponse, Parameter
from afspm.model.instruments import newest_of, target_of

_FIRST_LOOK_S, _LOOK_S = 0.02, 0.5
"""Real time between two readings of a value that has not arrived at its target: at first, doubled, and at most."""
_ROUNDED = 1e-3  # relative: an instrument may round a target, also at the end of a ramp in steps


class InstrumentTargets:
    """A setter of instrument targets that reads a value again and again until the value has arrived."""

    def __init__(self, link: ExperimentLink, control: ControlHold, commands: CommandRetry) -> None:
        self._link = link
        self._control = control
        self._commands = commands

    def reach(self, wanted: Parameter, until_s: float | None) -> Parameter:
        """Set a target, unless it is in force, and wait for the value; return the target in force, under its own name.

        Control must be held. Returns early if control is lost on the way: others may change the target then.

        Raises:
            Refused: the instrument or a limit refuses.
            NoResponse: as `arrival`.
        """
        self.first_reading(wanted.name, until_s)
        target, before = float(wanted.value or "nan"), self._read(target_of(wanted.name), wanted.unit, until_s)[0]
        if before is None or not _is_same(float(before), target):
            response = self._commands.ask(ControlRequest.PARAM, wanted, until_s=until_s)
            target = float(value_in(response, wanted, wanted.unit))
        self.arrival(wanted, target, until_s, in_control=True)
        return Parameter(target_of(wanted.name), repr(target), wanted.unit)

    def is_reached(self, wanted: Parameter, until_s: float | None) -> bool:
        """Return whether a target is in force and the instrument says that it has arrived."""
        self.first_reading(wanted.name, until_s)
        before = self._read(target_of(wanted.name), wanted.unit, until_s)[0]
        is_in_force = before is not None and _is_same(float(before), float(wanted.value or "nan"))
        return is_in_force and self._read(f"{wanted.name}.busy", None, until_s)[0] is False

    def in_force(self, name: str, until_s: float | None) -> Parameter:
        """Return the target in force; wait up to a minute for the first reading. Raises Refused without a target."""
        self.first_reading(name, until_s)
        response = self._commands.read(ControlRequest.PARAM, Parameter(target_of(name)), until_s)
        if not response.ok:
            raise refused(ControlRequest.PARAM, response, self._link.name)
        return replace(wire.decode_parameter(response.payload), name=name)

    def first_reading(self, name: str, until_s: float | None) -> None:
        """Wait, at most for a minute, until an instrument has reported a value."""
        # an instrument that is not connected yet, as when a run begins, would refuse the setting
        link = self._link
        give_up_s = link.earlier(PATIENCE_S, until_s)
        while self._read(name, None, until_s)[0] is None and link.clock.monotonic_s() < give_up_s:
            link.wait(lambda: False, link.earlier(_LOOK_S, until_s))

    def arrival(self, asked: Parameter, target: float, until_s: float | None, *, in_control: bool = False) -> Value:
        """Wait until the value has arrived at `target`, in the unit of `asked`; return the last value, NaN if unknown.

        Args:
            in_control: whether to return early once control is lost.

        Raises:
            NoResponse: another target was set meanwhile, the value did not arrive by `until_s`, or the instrument has
                had no value for a minute.
        """
        link, name, look_s = self._link, asked.name, _FIRST_LOOK_S
        lost_s: float | None = None
        while True:
            found = {part: self._read(f"{name}.{part}", asked.unit, until_s)[0] for part in ("target", "busy")}
            # the value of the last report may be from before its arrival
            value, why = self._read(name if found["busy"] else newest_of(name), asked.unit, until_s)
            if in_control and not self._control.held:
                return math.nan if value is None else value
            if found["target"] is not None and not _is_same(float(found["target"]), target):
                what = f"{name} does not go to {asked.value} {asked.unit or ''} any more"
                raise NoResponse(what, where=link.name, hint=f"its target is {found['target']:g} now")
            if found["busy"] is False and found["target"] is not None and value is not None:
                return value
            now_s = link.clock.monotonic_s()
            lost_s = None if value is not None else now_s if lost_s is None else lost_s
            if lost_s is not None and now_s - lost_s > PATIENCE_S:
                what = f"{name} has had no value for {PATIENCE_S:g} s on its way to {asked.value} {asked.unit or ''}"
                raise NoResponse(what, where=link.name, hint=why)
            link.wait(lambda: False, link.earlier(look_s, until_s))
            look_s = min(2.0 * look_s, _LOOK_S)
            if until_s is not None and link.clock.monotonic_s() >= until_s:
                raise NoResponse(f"{name} has not arrived at {asked.value} {asked.unit or ''} in time", where=link.name)

    def _read(self, name: str, unit: str | None, until_s: float | None) -> tuple[Value | None, str]:
        # None, and why, while the instrument has no recent reading: the wait outlasts a restart of its server
        response = self._commands.read(ControlRequest.PARAM, Parameter(name), until_s)
        if response.code == ControlResponse.PARAM_ERROR:
            return None, response.reason
        if not response.ok:
            raise refused(ControlRequest.PARAM, response, name)
        return value_in(response, Parameter(name), unit), ""


def _is_same(now: float, target: float) -> bool:
    return math.isclose(now, target, rel_tol=_ROUNDED)
