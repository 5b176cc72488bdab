"""Having control: asking for it, waiting for it, noticing that it is gone, giving it back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from afspm.client.link import ExperimentLink
from afspm.errors import ControlLost, ExperimentEnded, NoResponse, Refused
from afspm.model import ControlMode, ControlRequest, ControlResponse, ControlState, Packet, Problem, ProblemNames
from afspm.process.stopping import StopRequested

ASK_AGAIN_S = 10.0  # should a published control state ever not reach us
_WAIT_FOR = {
    ControlResponse.ALREADY_UNDER_CONTROL,
    ControlResponse.WRONG_CONTROL_MODE,
    ControlResponse.WRONG_EXP_PROBLEM,
}


class ControlHold:
    """Whether this component is in control, and what for.

    Attributes:
        held: we are in control.
        why_lost: for a person, why we no longer are.
        gives_back_inherited: give back whatever control an earlier life of this component died with.
        is_unbroken: in this block control that is lost is not waited for: nothing is asked for in a second tenure.

    That it is, the scheduler's answers say; that it no longer is, its published control state, once that has named us.
    (A state from before the grant may still be under way: it must not be taken for a loss.)
    """

    def __init__(self, link: ExperimentLink, problems: ProblemNames) -> None:
        self._link = link
        self._problems = problems
        self._wanted: list[int] = []
        self._seen = False
        self.held = False
        self.why_lost = ""
        self.gives_back_inherited = False
        self.is_unbroken = False
        link.listen(self._on_packet)

    @property
    def was_lost(self) -> bool:
        """Whether control is wanted and not there."""
        return bool(self._wanted) and not self.held

    @contextmanager
    def hold(
        self, *, solving: int = Problem.NONE, until_s: float | None = None, unbroken: bool = False
    ) -> Iterator[None]:
        """Have control in the block; within another such block it is that one's.

        Raises:
            ControlLost: it was not given until `until_s`; or, in the block, if `unbroken`, is no longer there.
            Refused: the problem to be solved is not flagged.
        """
        if self._wanted and solving in (Problem.NONE, self._wanted[0]):
            solving = self._wanted[0]
        elif self._wanted:
            raise ControlLost(
                f"control is held to solve {self._name(self._wanted[0])}, not {self._name(solving)}",
                where=self._link.name,
                hint="leave the one `with scope.control(...)` before the other begins",
            )
        self._wanted.append(solving)
        was_unbroken = self.is_unbroken
        try:
            self.regain(until_s)
            self.is_unbroken = was_unbroken or unbroken
            yield
        except (ExperimentEnded, StopRequested):
            self._wanted.pop()
            if not self._wanted and self.held:
                self._give_up()
            raise
        except BaseException:
            self._leave(quietly=True)
            raise
        else:
            self._leave(quietly=False)
        finally:
            self.is_unbroken = was_unbroken

    def regain(self, until_s: float | None = None) -> None:
        """Be in control: at once if we are, else ask, wait for the control state to change, and ask again.

        Raises:
            ControlLost: not until `until_s`, or what we wanted control for has been solved, or not without a break.
        """
        if self.is_unbroken and not self.held:
            raise ControlLost(
                f"control was lost: {self.why_lost}",
                where=self._link.name,
                hint="others may have moved the probe or set something: begin the block again",
            )
        solving = self._wanted[-1] if self._wanted else Problem.NONE
        view, clock = self._link.view, self._link.clock
        told = ""
        while not self.held:
            version, connections = view.count("ControlState"), self._link.connections
            response = self._link.request(ControlRequest.REQUEST_CTRL, int(solving), until_s=until_s)
            if response.ok:
                # the state that names us may have come before the answer
                self.held, self._seen = True, view.control is not None and view.control.holder == self._link.name
                break
            if response.code not in _WAIT_FOR:
                raise Refused(response.code, response.reason or "control was refused", where=self._link.name)
            if solving and response.code == ControlResponse.WRONG_EXP_PROBLEM and not self._is_flagged(solving):
                raise ControlLost(
                    f"{self._name(solving)} is not flagged: there is nothing to solve", where=self._link.name
                )
            told = self._tell_waiting(response.reason or self.obstacle(solving), told)
            again_s = clock.monotonic_s() + ASK_AGAIN_S
            self._link.wait(
                lambda v=version, c=connections: self._may_ask(solving, v, c),  # type: ignore[misc]
                again_s if until_s is None else min(again_s, until_s),
            )
            if until_s is not None and clock.monotonic_s() >= until_s:
                raise ControlLost(f"control was not given in time: {told}", where=self._link.name)
        if told:
            self._link.log.info("in control")

    def release_inherited(self) -> None:
        """Give back control that an earlier life had and nobody wants now: others wait for it."""
        state = self._link.view.control
        if state is not None and state.holder == self._link.name and not self._wanted and not self.held:
            self._link.send_only(ControlRequest.RELEASE_CTRL)

    def leave(self) -> None:
        """Give back control, if we have it, without waiting for the answer."""
        if self.held:
            self._give_up()

    def lost(self, why: str) -> None:
        """The scheduler says that we are not in control."""
        self.held = False
        self.why_lost = why

    def obstacle(self, solving: int = Problem.NONE) -> str:
        """What stands between us and control, for a person; empty if nothing does."""
        state = self._link.view.control
        if state is None:
            return ""
        if state.mode is ControlMode.MANUAL:
            return "the mode is MANUAL"
        if solving not in state.problems and (solving or state.problems):
            return ", ".join(map(self._name, state.problems)) + " flagged" if state.problems else "nothing to solve"
        if state.holder not in (None, self._link.name):
            return f"{state.holder} is in control"
        return ""

    def _may_ask(self, solving: int, version: int, connections: int) -> bool:
        if self._link.connections != connections:
            return True
        solved = bool(solving) and not self._is_flagged(solving)  # asking says so, for certain
        return self._link.view.count("ControlState") != version and (solved or not self.obstacle(solving))

    def _tell_waiting(self, why: str, told: str) -> str:
        if why != told:
            self._link.log.info("waiting for control: %s", why)
        return why

    def _is_flagged(self, problem: int) -> bool:
        state = self._link.view.control
        return state is not None and problem in state.problems

    def _name(self, problem: int) -> str:
        return self._problems.name(problem) if problem else "no problem"

    def _on_packet(self, packet: Packet, ours: bool) -> None:
        # the link's view is up to date before its listeners are called
        if not ours or not packet.envelope.startswith("ControlState") or self._link.view.control is None:
            return
        if self.held:
            self._on_control(self._link.view.control)
        elif self.gives_back_inherited:
            self.release_inherited()

    def _on_control(self, state: ControlState) -> None:
        if state.holder == self._link.name:
            self._seen = True
        elif self._seen:
            solving = self._wanted[-1] if self._wanted else Problem.NONE
            self.lost(self.obstacle(solving) or "it was taken away")

    def _leave(self, *, quietly: bool) -> None:
        """Give control back at the end of the outermost block; `quietly`: another exception is on its way."""
        self._wanted.pop()
        if self._wanted or not self.held:
            return
        self.held = False
        try:
            # that we were not in control any more is fine; on the way out of a failure nothing is waited for long
            self._link.request(
                ControlRequest.RELEASE_CTRL, until_s=self._link.until(self._link.request_timeout_s if quietly else None)
            )
        except (NoResponse, ExperimentEnded, StopRequested):
            if not quietly:
                raise

    def _give_up(self) -> None:
        """Give control back on the way out, when nothing can be waited for."""
        self.held = False
        if not self._link.ended:
            self._link.send_only(ControlRequest.RELEASE_CTRL)
