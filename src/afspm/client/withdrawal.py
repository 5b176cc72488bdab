"""The tip away from the sample, while another instrument goes to its next target."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from afspm import wire
from afspm.basics.errors import NoResponse, Refused
from afspm.client.command_retry import SETTLED_WITHIN_S, CommandRetry
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.keyed_results import KeyedResults
from afspm.model import ControlRequest, ControlResponse, Parameter, ScopeState, names

SHOWN_WITHIN_S = 20.0  # real time: the tip is published some readings after the state
APPROACH_S = 600.0  # real time: the coarse motor of a cold microscope takes minutes
_TWICE_S = 1.0  # experiment time between two readings of a tip that has arrived
_GIVE_UP_S = 60.0  # real time for the withdrawal after an approach that has failed


class Withdrawal:
    """A tip that is withdrawn and brought back; which of them is due is saved, so that a restart brings it back."""

    def __init__(
        self, link: ExperimentLink, control: ControlHold, commands: CommandRetry, results: KeyedResults
    ) -> None:
        self._link, self._control, self._commands, self._results = link, control, commands, results

    def withdraw(self, until_s: float | None, away: Sequence[str] = ()) -> None:
        """Withdraw the tip, and move it away by the actions `away`. Control must be held.

        Raises:
            Refused: another has withdrawn the tip; or as `bring_back`.
            NoResponse: as `bring_back`.
        """
        if self._is_engaged(until_s) is False:
            if not self._results.is_withdrawn:
                what = "the tip is withdrawn already, and not by this sweep, which would bring it to the sample"
                hint = f"bring it to the sample first ({names.ENGAGE})"
                raise Refused(ControlResponse.ACTION_ERROR, f"{what}: {hint}")
        else:
            self._results.is_withdrawn = True  # before, since after a kill it may be so
            self._move(names.RETRACT, until_s, engages=False)
        self._step(away, until_s)

    def away(self, away: Sequence[str], until_s: float | None) -> None:
        """Withdraw the tip, and move it away by the actions `away`; nothing brings it back. Raises as `bring_back`."""

        def withdraw() -> None:
            if self._is_engaged(until_s) is not False:
                self._move(names.RETRACT, until_s, engages=False)

        self._until_undisturbed(withdraw)
        self._step(away, until_s)

    def bring_back(self, until_s: float | None, *, approaches: bool = False) -> None:
        """Bring the tip to the sample, if `withdraw` has withdrawn it. Control must be held.

        Args:
            approaches: whether it was moved away by more than its piezo.

        Raises:
            Refused: the microscope refuses, or reports that the tip is not where it should be.
            NoResponse: the microscope is not free again by `until_s`.
        """
        if self._results.is_withdrawn:
            if approaches:
                self.approach(self._link.earlier(APPROACH_S, until_s))
            elif self._is_engaged(until_s) is not True:
                self._move(names.ENGAGE, until_s, engages=True)
            self.leave_withdrawn()

    def approach(self, until_s: float | None) -> None:
        """Bring the tip to the sample from any distance; if it is not there, withdraw it. Control must be held.

        Raises:
            Refused: the microscope refuses, or the tip was not read at the sample twice.
            NoResponse: the microscope is not free again by `until_s`.
        """
        support = self._commands.read(ControlRequest.ACTION_SUPPORT, names.APPROACH, until_s)
        action = names.APPROACH if support.ok else names.ENGAGE

        def approach() -> None:
            self._act(action, until_s)
            for again_s in (_TWICE_S, 0.0):
                if self._is_engaged(until_s) is not True:
                    why = f"the tip was not read at the sample twice after {action}, so it is withdrawn"
                    raise Refused(ControlResponse.ACTION_ERROR, why)
                self._wait(lambda: False, self._link.until(self._link.clock.real_s(again_s)))

        try:
            self._until_undisturbed(approach)
        except (Refused, NoResponse) as error:
            self._link.log.error("the approach has failed, and the tip is withdrawn: %s", error)
            self._act(names.RETRACT, self._link.until(_GIVE_UP_S))
            raise

    def leave_withdrawn(self) -> None:
        """Forget that the tip was withdrawn: nothing brings it back."""
        self._results.is_withdrawn = False

    def _is_engaged(self, until_s: float | None) -> bool | None:
        # read now: the tip is published some readings after it moved
        response = self._commands.read(ControlRequest.PARAM, Parameter(names.ENGAGED), until_s)
        if not response.ok or not response.payload:
            return None
        value = (wire.decode_parameter(response.payload).value or "").lower()
        return True if value in names.ON_WORDS else False if value in names.OFF_WORDS else None

    def _until_undisturbed(self, move: Callable[[], None]) -> None:
        # a failure says nothing if others had the microscope meanwhile: they may have stopped the move, or gone on
        while True:
            tenures = self._control.tenures
            try:
                return move()
            except (Refused, NoResponse) as error:
                if self._control.tenures == tenures:
                    raise
                self._link.log.warning("once more, since others had the microscope meanwhile: %s", error)

    def _step(self, away: Sequence[str], until_s: float | None) -> None:
        for action in away:
            self._act(action, until_s)

    def _act(self, action: str, until_s: float | None) -> None:
        link, view = self._link, self._link.view
        self._commands.ask(ControlRequest.ACTION, action, until_s=until_s)
        # FREE may be the end of the action before; an action that is over already shows no other state
        link.wait(lambda: view.state is not ScopeState.FREE, link.earlier(SETTLED_WITHIN_S, until_s))
        if not self._wait(lambda: view.state is ScopeState.FREE, until_s):
            raise NoResponse(f"{action} has not ended in time", where=link.name)

    def _move(self, action: str, until_s: float | None, *, engages: bool) -> None:
        self._act(action, until_s)
        link, view = self._link, self._link.view
        is_shown = self._wait(
            lambda: view.tip is None or view.tip.engaged in (None, engages), link.earlier(SHOWN_WITHIN_S, until_s)
        )
        if not is_shown:
            place = "withdrawn" if engages else "at the sample"
            raise Refused(ControlResponse.ACTION_ERROR, f"the microscope reports the tip as {place} after {action}")

    def _wait(self, done: Callable[[], bool], until_s: float | None) -> bool:
        # in an unbroken block a loss of control is an error: others may have moved the tip
        is_done = self._link.wait(lambda: done() or not self._control.held, until_s)
        self._control.regain(until_s)
        return is_done
