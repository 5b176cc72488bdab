"""Setup of the microscope for a measurement: region, shape, probe position and kind of spectrum."""

from __future__ import annotations

from collections.abc import Collection

from afspm.basics.errors import ControlLost, NotClear
from afspm.client.command_retry import CommandRetry
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import PublishedState
from afspm.client.instrument_targets import InstrumentTargets
from afspm.client.targets import FITS, SAME, XY, ScanTarget, Target, is_set
from afspm.client.withdrawal import Withdrawal
from afspm.model import (
    ControlRequest,
    Feedback,
    Frame,
    Parameter,
    ProbePosition,
    Region,
    ScanParameters,
    is_of_instrument,
    names,
)
from afspm.model.positions import PLACES


class MeasurementSetup:
    """A setter of the microscope's settings for a measurement. Control must be held during each call.

    A region, a shape or a probe position already in force is not sent again. A region in sample coordinates is sent
    each time, since the sample drifts.

    Args:
        view: the published settings in force.

    Attributes:
        holds_z: whether z is held by this component, whose settings stay as they were when it began.
    """

    def __init__(
        self,
        view: PublishedState,
        control: ControlHold,
        commands: CommandRetry,
        targets: InstrumentTargets,
        withdrawal: Withdrawal,
    ) -> None:
        self._view = view
        self._control = control
        self._commands = commands
        self._targets = targets
        self._withdrawal = withdrawal
        self.holds_z = False
        self._is_shown = False
        self._rounded: tuple[ScanParameters, ScanParameters | None] | None = None

    def reach(self, target: Target, until_s: float | None) -> tuple[Parameter, ...]:
        """Set the parameters of other instruments, wait until they have arrived, and return their targets in force.

        Raises as `InstrumentTargets.reach` and `Withdrawal.bring_back`; returns early if control is lost.
        """
        others = [one for one in target.settings if is_of_instrument(one.name)]
        if target.aside is None:
            return tuple(self._targets.reach(one, until_s) for one in others)
        while True:
            try:
                # after a loss of control others may move the tip: nothing in the block goes on
                with self._control.hold(until_s=until_s, unbroken=True):
                    if not all(self._targets.is_reached(one, until_s) for one in others):
                        self._withdrawal.withdraw(until_s, target.aside)
                    reached = tuple(self._targets.reach(one, until_s) for one in others)
                    self._withdrawal.bring_back(until_s, approaches=bool(target.aside))
                return reached
            except ControlLost:
                return ()  # the measurement begins again, with its targets
            except NotClear:  # the scheduler has logged why; each round makes the steps away again
                if not target.aside:
                    raise

    def prepare(self, target: Target, key: str, until_s: float | None, reached: tuple[Parameter, ...] = ()) -> None:
        """Set all settings of a target, and publish its sweep parameters with the values in force.

        Args:
            reached: the targets of other instruments, as `reach` returned them.
        """
        if isinstance(target, ScanTarget):
            self.set_scan(target.parameters, until_s)
        else:
            if target.kind is not None:
                self._commands.ask(ControlRequest.PARAM, Parameter(names.SPEC_KIND, target.kind), until_s=until_s)
            if target.at_m is not None:
                self.move_probe(target.at_m, until_s)
        swept = () if target.point is None else tuple(one.name for one in target.settings)
        in_force = self.lend(target.lent, target.settings, until_s, target.settle_s, swept)
        # without a key the record takes them as those of all later measurements: the next one withdraws them
        if target.settings or self._is_shown:
            shown = (in_force[one.name] for one in target.settings if one.name in in_force)
            self._commands.publish_settings((*reached, *shown), key, target.point)
            self._is_shown = bool(target.settings) and not key

    def lend(
        self,
        of_block: tuple[Parameter, ...],
        own: tuple[Parameter, ...],
        until_s: float | None,
        settle_s: float | None = None,
        swept: Collection[str] = (),
    ) -> dict[str, Parameter]:
        """State settings for the next measurement, and return those in force by name.

        Args:
            of_block: of the enclosing blocks, which `own` ones come before.
            swept: the parameters that are points of a sweep.
        """
        decided = self._commands.decided
        of_block = () if self.holds_z else tuple(one for one in of_block if one.name not in decided)
        wanted = {one.name: one for one in (*of_block, *own) if not is_of_instrument(one.name)}
        # where to measure is mapped onto the sample, and others set it for their own measurements
        places = {name: self._commands.set_parameter(one, until_s) for name, one in wanted.items() if name in PLACES}
        wanted = {name: one for name, one in wanted.items() if name not in places}
        # what was stated for a measurement that did not begin must not hold for this one
        is_needed = bool(wanted) or (self._commands.states and not self.holds_z)
        lent = self._commands.lend(tuple(wanted.values()), until_s, settle_s, swept) if is_needed else {}
        return {**places, **lent}

    def move_probe(self, xy_m: XY, until_s: float | None, *, drifts: bool = False) -> None:
        """Move the probe to (x, y) in m, unless it is there already.

        Args:
            drifts: whether the place is one of the sample, which is elsewhere for the tip a while later.
        """
        now = self._view.probe_position
        if drifts or now is None or now.xy_m != xy_m:
            self._commands.set(ControlRequest.SET_PROBE_POS, ProbePosition(xy_m), "ProbePosition", until_s)

    def set_scan(self, wanted: ScanParameters, until_s: float | None) -> None:
        """Set region and shape together, unless both are in force."""
        if wanted.region is None and wanted.shape is None:
            return
        # in sample coordinates a region drifts: a while later the same region is elsewhere for the tip
        is_fixed = not (isinstance(wanted.region, Region) and wanted.region.frame is Frame.SAMPLE)
        now = self._view.scan_parameters
        if is_fixed and (is_set(wanted, now, SAME) or (now is not None and (wanted, now) == self._rounded)):
            return
        self._commands.set(ControlRequest.SET_SCAN_PARAMS, wanted, "ScanParameters2d", until_s)
        # a controller may round: remember the rounded values of this request, unless they are another's setting
        now = self._view.scan_parameters
        self._rounded = (wanted, now) if is_set(wanted, now, FITS) else None

    def set_feedback(self, wanted: Feedback, until_s: float | None) -> None:
        """Set the given fields of the feedback; if one of them changes, wait until the feedback is published."""
        now = self._view.feedback
        if now and all(value in (None, getattr(now, name)) for name, value in vars(wanted).items()):
            self._commands.ask(ControlRequest.SET_ZCTRL_PARAMS, wanted, until_s=until_s)
        else:
            self._commands.set(ControlRequest.SET_ZCTRL_PARAMS, wanted, "ZCtrlParameters", until_s)
