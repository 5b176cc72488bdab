"""The workshop: fresh places on the sample for treatments of the tip."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from afspm import wire
from afspm.basics import ControlLost
from afspm.basics.errors import FileError, NoResponse, Refused
from afspm.basics.formatting import position_text
from afspm.client.component import Component
from afspm.components.tip_treatments import XY, Pulse, Treatment, TreatmentPlaces, clearance_m
from afspm.model import Region, ScopeState, names

SETTLED_WITHIN_S = 2.0  # real time: a microscope that has not reported to be busy by then counts as ready
DONE_ACTION = "ActionMsg"


class TipWorkshop:
    """Treatments of the tip for a component, which must hold control around every call.

    Args:
        charge: called with the treatment before each attempt. Its changes of the memory are saved before the attempt;
            an error that it raises prevents the attempt.

    Attributes:
        refused: treatments of the present repair that could not be done.
    """

    def __init__(
        self,
        component: Component,
        problem: str,
        places: TreatmentPlaces,
        charge: Callable[[Treatment], None],
    ) -> None:
        self._component = component
        self._scope, self._log, self._memory = component.scope, component.log, component.memory
        self._problem = problem
        self._places = places
        self._charge = charge
        self.refused: set[Treatment] = set()
        self._frame: Region | None = None  # the frame set about a place

    def treat(self, number: int, treatment: Treatment, safe: tuple[Region, ...]) -> bool:
        """Do the `number`-th treatment at a fresh place, without losing control between move and treatment.

        A treatment interrupted by a loss of control is retried at another place, while the problem is flagged.

        Returns:
            Whether the treatment was done.

        Raises:
            FileError: the state can't be saved; the treatment is not attempted.
            ControlLost: control was lost, and the problem is no longer flagged.
        """
        is_done = self._attempt(number, treatment, safe)
        if not is_done:
            self.refused.add(treatment)
        return is_done

    def _attempt(self, number: int, treatment: Treatment, safe: tuple[Region, ...]) -> bool:
        while True:
            self._charge(treatment)
            place = self._fresh_place(number)
            try:
                with self._scope.control(unbroken=True):
                    return self._treat_at(place, treatment, safe)
            except Refused as refused:
                self._log.warning("%s was refused: %s", treatment, refused.reason)
                return False
            except ControlLost as lost:
                if not self._scope.is_flagged(self._problem):
                    raise
                self._log.warning("%s was interrupted: %s; retrying at a fresh place", treatment, lost.what)

    def _fresh_place(self, number: int) -> XY:
        # counted before it is done: after a kill a treatment is left out rather than repeated
        places = int(self._memory.get("places", 0))
        self._memory["tried"], self._memory["places"] = number, places + 1
        if not self._memory.save():
            raise FileError("the disk is full: after a restart the treatment would be repeated")
        return self._places.fresh(places)

    def _treat_at(self, place: XY, treatment: Treatment, safe: tuple[Region, ...]) -> bool:
        parameters = self._scope.scan_parameters  # a person may have chosen another region meanwhile
        if parameters is not None and isinstance(parameters.region, Region) and parameters.region != self._frame:
            safe = (*safe, parameters.region)
        if (away := min(clearance_m(place, region) for region in safe)) < self._places.keep_away_m:
            self._log.error(
                "%s was not done: its place is only %.0f nm away from a scanned region", treatment, away * 1e9
            )
            return False
        action = names.PULSE if isinstance(treatment, Pulse) else names.CRASH
        if not self._scope.supports(action):
            self._log.warning("%s was not done: the microscope has no %s", treatment, action)
            return False
        self._go_to(place)
        self._prepare(treatment)
        if not self._scope.wait_until(
            lambda: self._stands_at(place) or not self._scope.in_control, timeout_s=SETTLED_WITHIN_S
        ):
            self._log.error(
                "%s was not done: the probe is %s, and not at %s", treatment, self._where(), position_text(place)
            )
            return False
        where = self._where()
        self._act(action)
        self._log.info("%s %s", treatment, where)
        self._component.publish(wire.message_type(DONE_ACTION)(action=action), f"{DONE_ACTION}_{self._component.name}")
        return True

    def _go_to(self, place: XY) -> None:
        # some microscopes move the tip only together with the scan frame
        try:
            self._scope.move_probe(place)
        except Refused as refused:
            parameters = self._scope.scan_parameters
            if parameters is None or not isinstance(parameters.region, Region):
                raise
            self._log.debug("moving the scan frame along to %s: %s", position_text(place), refused.reason)
            size_m = (self._places.spacing_m, self._places.spacing_m)
            self._frame = replace(parameters.region, center_m=place, size_m=size_m)
            self._scope.set_scan_region(self._frame)
            self._scope.move_probe(place)

    def _stands_at(self, place: XY) -> bool:
        position = self._scope.probe_position
        return position is not None and math.dist(position.xy_m, place) <= self._places.spacing_m / 2

    def _where(self) -> str:
        position = self._scope.probe_position
        return "an unknown place" if position is None else f"at {position_text(position.xy_m)}"

    def _act(self, action: str) -> None:
        # a busy microscope refuses the next action, so wait until this one has ended
        with self._scope.events("ScopeStateMsg", timeout_s=SETTLED_WITHIN_S) as states:
            try:
                self._scope.action(action)
            except NoResponse as silent:
                self._log.warning("%s; it counts as done: %s", silent.what, silent.hint)
                return
            was_busy = False
            for event in states:
                if event.message.state is ScopeState.FREE and was_busy:
                    return
                was_busy = True

    def _prepare(self, treatment: Treatment) -> None:
        if isinstance(treatment, Pulse):
            self._scope.set(names.PULSE_VOLTAGE, treatment.voltage_v, "V")
            self._scope.set(names.PULSE_DURATION, treatment.duration_s, "s")
        else:
            self._scope.set(names.CRASH_DEPTH, treatment.depth_m, "m")
            self._scope.set(names.CRASH_SPEED, treatment.speed_m_per_s, "m/s")
