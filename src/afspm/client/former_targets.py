"""The values before a sweep that the scheduler does not set back, and their way back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from afspm import wire
from afspm.basics.errors import Refused
from afspm.client.command_retry import CommandRetry, refused
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.instrument_targets import InstrumentTargets
from afspm.client.keyed_results import KeyedResults
from afspm.model import ControlRequest, Parameter, is_of_instrument
from afspm.model.positions import PLACES


class FormerTargets:
    """The values of swept parameters that can't be lent, as they were before, to be set at the end of a sweep.

    These are targets of other instruments, for which nothing waits then, places, and what changes other numbers.

    Args:
        names: the swept parameters.
        key: name of the plan; the targets are then saved on disk, and set even after a restart of the component.
    """

    def __init__(
        self,
        names: Sequence[str],
        key: str | None,
        link: ExperimentLink,
        control: ControlHold,
        commands: CommandRetry,
        targets: InstrumentTargets,
        results: KeyedResults,
    ) -> None:
        self._names, self._key = names, key
        self._link, self._control, self._commands, self._targets = link, control, commands, targets
        self._results = results
        # of runs of earlier versions with those of the microscope, too
        self._before = None if key is None else results.before_sweep(key)

    def remember(self, until_s: float | None) -> None:
        """Read the targets and places, once. Control must be held."""
        if self._before is None:
            for name in self._names:  # of an earlier sweep
                self._commands.decided.pop(name, None)
            self._keep(
                [self._in_force(name, until_s) for name in self._names if is_of_instrument(name) or name in PLACES]
            )

    def add_decided(self) -> None:
        """Remember the former values of parameters that the scheduler has set, and does not lend."""
        known = {one.name for one in self._before or ()}
        of_scheduler = self._commands.decided
        new = [before for name in self._names if name not in known and (before := of_scheduler.get(name)) is not None]
        if new:
            self._keep([*(self._before or ()), *new])

    def _in_force(self, name: str, until_s: float | None) -> Parameter:
        if is_of_instrument(name):
            return self._targets.in_force(name, until_s)
        response = self._commands.read(ControlRequest.PARAM, Parameter(name), until_s)
        if not response.ok:
            raise refused(ControlRequest.PARAM, response, name)
        return wire.decode_parameter(response.payload)

    def set_back(self, until_s: float | None) -> None:
        """Set the former targets; one that the instrument refuses is logged.

        Raises:
            ControlLost, NoResponse: they are not set by `until_s`. A later call can still do so, with a key even after
                a restart.
        """
        if not self._before:
            return
        is_back = True
        with self._control.hold(until_s=until_s):
            for parameter in reversed(self._before):
                try:
                    self._commands.set_parameter(parameter, until_s)
                except Refused as error:
                    is_back = False
                    text = "%s stays as it was set, and is not set back to %s: %s"
                    self._link.log.error(text, parameter.name, _amount(parameter), error.what)
        self._keep(None)
        if is_back:
            self._link.log.info("the parameters are set back")

    @property
    def left_behind(self) -> str:
        """Return the former values that are not in force again, as text; empty if all are."""
        return ", ".join(f"{one.name} {_amount(one)}" for one in self._before or ())

    def _keep(self, before: list[Parameter] | None) -> None:
        self._before = before
        if self._key is not None:
            self._results.keep_before_sweep(self._key, before)


def partition(names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return the parameters of other instruments, and those of the microscope."""
    found = list(names)
    of_others = [name for name in found if is_of_instrument(name)]
    return of_others, [name for name in found if name not in of_others]


def _amount(parameter: Parameter) -> str:
    return " ".join(filter(None, (parameter.value, parameter.unit)))
