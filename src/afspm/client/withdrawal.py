"""The tip away from the sample, while another instrument goes to its next target."""

from __future__ import annotations

from afspm.basics.errors import NoResponse, Refused
from afspm.client.command_retry import SETTLED_WITHIN_S, CommandRetry
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.keyed_results import KeyedResults
from afspm.model import ControlRequest, ControlResponse, ScopeState, names

SHOWN_WITHIN_S = 20.0  # real time: the tip is published some readings after the state


class Withdrawal:
    """A tip that is withdrawn and brought back; which of them is due is saved, so that a restart brings it back."""

    def __init__(
        self, link: ExperimentLink, control: ControlHold, commands: CommandRetry, results: KeyedResults
    ) -> None:
        self._link, self._control, self._commands, self._results = link, control, commands, results

    def withdraw(self, until_s: float | None) -> None:
        """Withdraw the tip. Control must be held. Raises as `bring_back`."""
        self._results.is_withdrawn = True  # before, since after a kill it may be so
        self._move(names.RETRACT, until_s, engages=False)

    def bring_back(self, until_s: float | None) -> None:
        """Bring the tip to the sample, if `withdraw` was called last; nothing is done without control.

        Raises:
            Refused: the microscope refuses, or reports that the tip is not where it should be.
            NoResponse: the microscope is not free again by `until_s`.
        """
        if self._results.is_withdrawn and self._control.held:
            self._move(names.ENGAGE, until_s, engages=True)
            self.leave_withdrawn()

    def leave_withdrawn(self) -> None:
        """Forget that the tip was withdrawn: nothing brings it back."""
        self._results.is_withdrawn = False

    def _move(self, action: str, until_s: float | None, *, engages: bool) -> None:
        link, view = self._link, self._link.view
        if view.tip is not None and view.tip.engaged is engages:
            return
        count = view.count("ScopeStateMsg")
        self._commands.ask(ControlRequest.ACTION, action, until_s=until_s)
        link.wait(lambda: view.count("ScopeStateMsg") != count, link.earlier(SETTLED_WITHIN_S, until_s))
        if not link.wait(lambda: view.state is ScopeState.FREE, until_s):
            raise NoResponse(f"{action} has not ended in time", where=link.name)
        if not link.wait(
            lambda: view.tip is None or view.tip.engaged in (None, engages), link.earlier(SHOWN_WITHIN_S, until_s)
        ):
            place = "withdrawn" if engages else "at the sample"
            raise Refused(ControlResponse.ACTION_ERROR, f"the microscope reports the tip as {place} after {action}")
