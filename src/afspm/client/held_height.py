"""`HeldHeight`: the height of a tip that is held without feedback, in a block of `Scope.hold_z`."""

from __future__ import annotations

from afspm.basics.errors import ControlLost
from afspm.client.command_retry import CommandRetry, refused
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.parameter_text import Value, to_parameter
from afspm.model import ControlRequest, Parameter, ScopeState, names
from afspm.model.instruments import newest_of


class HeldHeight:
    """A tip that stands at an offset from the height of its setpoint, without feedback.

    Args:
        bounds: the settings of the hold: speed, and the bounds at which the translator ends it.
        until_s: real time until which control and a free microscope are awaited.
    """

    def __init__(
        self,
        bounds: tuple[Parameter, ...],
        until_s: float | None,
        *,
        link: ExperimentLink,
        control: ControlHold,
        commands: CommandRetry,
    ) -> None:
        self._bounds, self._until_s = bounds, until_s
        self._link, self._control, self._commands = link, control, commands

    def prepare(self, offset: float | str) -> None:
        """Set the bounds, and let the limits judge the offset, before anything is switched. Control must be held.

        Raises:
            Refused: the microscope can't hold z, or a limit refuses.
        """
        response = self._commands.read(ControlRequest.ACTION_SUPPORT, names.HOLD_Z, self._until_s)
        if not response.ok:
            raise refused(ControlRequest.ACTION, response, self._link.name)
        # without a held z nothing moves
        for parameter in (*self._bounds, to_parameter(names.HELD_Z_OFFSET, offset, None)):
            self._commands.ask(ControlRequest.PARAM, parameter, until_s=self._until_s)

    def begin(self, offset: float | str, bias: float | str | None) -> None:
        """Switch the feedback off, set the bias, and move to the offset.

        Raises:
            Refused: the microscope or a limit refuses, or the way to the offset was broken off.
        """
        self._commands.ask(ControlRequest.ACTION, names.HOLD_Z, until_s=self._until_s)
        if bias is not None:
            wanted = to_parameter(names.TIP_BIAS_VOLTAGE, bias, None)
            self._commands.ask(ControlRequest.PARAM, wanted, until_s=self._until_s)
        self.move(offset)

    def move(self, offset: float | str) -> None:
        """Move to another offset: negative towards the sample, at the speed of the block; return when it is there.

        Raises:
            Refused: a limit refuses it, or z is held no more.
        """
        states = self._link.view.count("ScopeStateMsg")
        aim = to_parameter(names.HELD_Z_OFFSET, offset, None)
        self._commands.ask(ControlRequest.PARAM, aim, until_s=self._until_s)
        self._wait_free(states)
        self.check()

    def read(self, parameter: str, unit: str | None = None) -> Value:
        """Return a parameter as `Scope.read` does, as long as z is held at the reading.

        Raises:
            Refused: z is held no more; the reason says why.
        """
        value = self._commands.value(newest_of(parameter), unit, self._until_s)
        self.check()
        return value

    def check(self) -> None:
        """Raise Refused with the reason if z is held no more: a bound was reached, or the tip was withdrawn."""
        self._require_control()
        if not self._commands.value(names.Z_IS_HELD, None, self._until_s):
            self._end()

    def release(self) -> None:
        """Begin the way back, and return when the feedback is on.

        Raises:
            ControlLost: z was held no more, since the scheduler has begun the way back.
            Refused: z was held no more, or the way back failed; the reason says why.
        """
        self._require_control()
        self._end()
        if not self._commands.value(names.FEEDBACK_ON, None, self._until_s):
            self._end()

    def _require_control(self) -> None:
        if self._control.was_lost:
            raise ControlLost(f"control was lost while z was held: {self._control.why_lost}", where=self._link.name)

    def _end(self) -> None:
        states = self._link.view.count("ScopeStateMsg")
        self._commands.ask(ControlRequest.ACTION, names.RELEASE_Z, until_s=self._until_s)
        self._wait_free(states)

    def _wait_free(self, states: int) -> None:
        # a state later than `states`: the move is published as MOVING right after the answer
        view = self._link.view
        with self._link.clock.passing():
            self._link.wait(
                lambda: view.count("ScopeStateMsg") != states and view.state is ScopeState.FREE, self._until_s
            )
