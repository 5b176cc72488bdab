"""The targets of other instruments before a sweep, and their way back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from afspm.basics.errors import Refused
from afspm.client.command_retry import CommandRetry
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.instrument_targets import InstrumentTargets
from afspm.client.keyed_results import KeyedResults
from afspm.model import Parameter, is_of_instrument


class FormerTargets:
    """The targets of other instruments before a sweep, to be set at its end; nothing waits until they have arrived.

    Args:
        names: the parameters.
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
        """Read the targets, once. Control must be held."""
        if self._before is None and self._names:
            self._keep([self._targets.in_force(name, until_s) for name in self._names])

    def set_back(self, until_s: float | None) -> None:
        """Set the former targets; one that the instrument refuses is logged.

        Raises:
            ControlLost, NoResponse: they are not set by `until_s`. A later call can still do so, with a key even after
                a restart.
        """
        if self._before is None:
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
