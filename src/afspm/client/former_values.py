"""The values of parameters before a sweep or a series of curves, and their way back."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from afspm import wire
from afspm.basics.errors import Refused
from afspm.client.command_retry import CommandRetry, refused
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.instrument_targets import InstrumentTargets
from afspm.client.keyed_results import KeyedResults
from afspm.model import ControlRequest, Parameter, is_of_instrument

Steps = Callable[[Parameter, Parameter], Sequence[Parameter]]
"""Values on the way from the present value to the former one, where a limit may refuse the whole way."""


class FormerValues:
    """The values of parameters that a plan sets, as they were before it, to be set back at its end.

    Args:
        names: the parameters.
        key: name of the plan; the values are then saved on disk, and set back even after a restart of the component.
        first: set before the values are read or set back: the kind of curve, since each has points of its own.
    """

    def __init__(
        self,
        names: Sequence[str],
        key: str | None,
        *,
        link: ExperimentLink,
        control: ControlHold,
        commands: CommandRetry,
        targets: InstrumentTargets,
        results: KeyedResults,
        steps: Steps = lambda now, before: (),
        first: Parameter | None = None,
    ) -> None:
        self._names, self._key, self._steps = names, key, steps
        self._link, self._control, self._commands, self._targets = link, control, commands, targets
        self._results, self._first = results, first
        self._before = None if key is None else results.before_sweep(key)

    def remember(self, until_s: float | None) -> None:
        """Read the values, once. Control must be held."""
        if self._before is None:
            self._begin(until_s)
            self._keep([self._in_force(name, until_s) for name in self._names])

    def _begin(self, until_s: float | None) -> None:
        if self._first is not None:
            self._commands.ask(ControlRequest.PARAM, self._first, until_s=until_s)

    def set_back(self, until_s: float | None) -> None:
        """Set the parameters to their former values; a value that the microscope refuses is logged.

        Other instruments get their targets from before; nothing waits until they have arrived.

        Raises:
            ControlLost, NoResponse: the parameters are not set back by `until_s`. A later call can still do so, with a
                key even after a restart.
        """
        if self._before is None:
            return
        is_back = True
        with self._control.hold(until_s=until_s):
            self._begin(until_s)
            for parameter in reversed(self._before):
                try:
                    self._set_back(parameter, until_s)
                except Refused as error:
                    is_back = False
                    text = "%s stays as it was set, and is not set back to %s: %s"
                    self._link.log.error(text, parameter.name, _amount(parameter), error.what)
            self._commands.publish_settings((), "")
        self._keep(None)
        if is_back:
            self._link.log.info("the parameters are set back")

    @property
    def left_behind(self) -> str:
        """Return the former values that are not in force again, as text; empty if all are."""
        return ", ".join(f"{one.name} {_amount(one)}" for one in self._before or ())

    def _set_back(self, before: Parameter, until_s: float | None) -> None:
        try:
            self._commands.set_parameter(before, until_s)
        except Refused:
            # a limit on steps may refuse the whole way, and allow the steps of the plan
            between = self._steps(self._in_force(before.name, until_s), before)
            if not between:
                raise
            for parameter in (*between, before):
                self._commands.set_parameter(parameter, until_s)

    def _in_force(self, name: str, until_s: float | None) -> Parameter:
        if is_of_instrument(name):
            return self._targets.in_force(name, until_s)
        response = self._commands.read(ControlRequest.PARAM, Parameter(name), until_s)
        if not response.ok:
            raise refused(ControlRequest.PARAM, response, name)
        return wire.decode_parameter(response.payload)

    def _keep(self, before: list[Parameter] | None) -> None:
        self._before = before
        if self._key is not None:
            self._results.keep_before_sweep(self._key, before)


def _amount(parameter: Parameter) -> str:
    return " ".join(filter(None, (parameter.value, parameter.unit)))
