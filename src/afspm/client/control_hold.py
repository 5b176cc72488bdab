"""Control of the microscope: request, wait, detection of a loss, and release."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from afspm.basics import ControlLost
from afspm.basics.errors import ExperimentEnded, NoResponse, Refused
from afspm.client.experiment_link import ExperimentLink
from afspm.model import (
    LEASE_AT_ONCE_S,
    LEASE_REQUEST,
    WAIT_FOR_CONTROL,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Packet,
    Problem,
    ProblemNames,
)
from afspm.transport.process.parent import StopRequested
from afspm.wire.messages import FEEDBACK

ASK_AGAIN_S = 10.0  # in case a published control state was lost
NAMED_WITHIN_S = 10.0  # for the control state that names this component, which is published before the answer


class ControlHold:
    """The component's control of the microscope, and the problem to solve with it.

    The scheduler's answer grants control. A published state with another holder means loss, but only after a state
    that names this component: a state from before the grant may arrive after the answer.

    Attributes:
        held: whether the component is in control.
        tenures: number of grants of control.
        why_lost: reason of the last loss, for people.
        gives_back_inherited: whether to release control that no block of this life has requested, or still waits for.
        is_unbroken: whether a loss of control in the present block is an error: all requests belong to one grant.
        switched: the last switching of the feedback: number of its messages published before, and whether it is on.
    """

    def __init__(self, link: ExperimentLink, problems: ProblemNames) -> None:
        self._link = link
        self._problems = problems
        self._wanted: list[int] = []
        self._keeping = 0  # blocks that keep control while they wait
        self._was_named = False
        self._was_off = False  # the feedback, at the beginning of the outermost block
        self.held = False
        self.tenures = 0
        self.why_lost = ""
        self.gives_back_inherited = False
        self.is_unbroken = False
        self.switched: tuple[int, bool] | None = None
        link.listen(self._on_packet)

    @property
    def was_lost(self) -> bool:
        """Return whether control is wanted and not held."""
        return bool(self._wanted) and not self.held

    @contextmanager
    def hold(
        self, *, solving: int = Problem.NONE, until_s: float | None = None, unbroken: bool = False, keeps: bool = False
    ) -> Iterator[None]:
        """Hold control in the block; an inner block shares the control of the outer one.

        A block that `keeps` control has it also while a limit on time lets it wait; other blocks give it back then.

        If an error, or the stop of this process, ends the outermost block, and the block has switched the feedback off,
        control is not released but lost: the scheduler retracts the tip, since no other component knows of the danger.

        Raises:
            ControlLost: control was not given by `until_s`; the problem to solve is not flagged; an outer block solves
                another problem; or, in an unbroken block, control was lost.
            Refused: the scheduler refuses control for another reason.
        """
        if self._wanted and solving not in (Problem.NONE, self._wanted[0]):
            raise ControlLost(
                f"control is held to solve {self._name(self._wanted[0])}, not {self._name(solving)}",
                where=self._link.name,
                hint="leave the one `with scope.control(...)` before the other begins",
            )
        self._wanted.append(self._wanted[0] if self._wanted else solving)
        was_unbroken = self.is_unbroken
        try:
            with self._link.interrupts.heeded():
                # Packets from a long computation of the caller may wait: a measurement of another component would look
                # like the result of this block, and a moved probe as if it were still in its place.
                self._link.take_in()
                self.regain(until_s)
            if len(self._wanted) == 1:
                self._was_off = self._is_off
            self.is_unbroken = was_unbroken or unbroken
            with self.kept() if keeps else nullcontext():
                yield
        except (ExperimentEnded, StopRequested):
            self._wanted.pop()
            if not self._wanted and self._has_switched_off:
                self.held = False  # not given back: once this process has ended, the scheduler retracts the tip
            elif not self._wanted:
                self.leave()
            raise
        except BaseException as error:  # also Ctrl-C: control must be released on every way out of the block
            # after Ctrl-C a person attends to the tip
            self._end_block(quietly=True, in_danger=isinstance(error, Exception) and self._has_switched_off)
            raise
        else:
            self._end_block(quietly=False)
        finally:
            self.is_unbroken = was_unbroken

    def regain(self, until_s: float | None = None) -> None:
        """Wait until control is held.

        Control is requested at once, after each change of the control state that may allow it, after a reconnection,
        and every `ASK_AGAIN_S`.

        Raises:
            ControlLost: control was not given by `until_s`, the problem to solve is not flagged, or control was lost in
                an unbroken block.
            Refused: the scheduler refuses control for another reason.
        """
        link, solving = self._link, self._solving
        if self.is_unbroken and not self.held:
            raise ControlLost(
                f"control was lost: {self.why_lost}",
                where=link.name,
                hint="others may have moved the probe or set something: begin the block again",
            )
        reported = ""
        while not self.held:
            may_ask = link.or_reconnected(self._when_changed(solving))
            with link.clock.late():
                obstacle = self._ask(solving, until_s)
                if obstacle is None:
                    self._take_in_earlier_packets(until_s)
                    continue
            if obstacle != reported:
                link.log.info("waiting for control: %s", obstacle)
            reported = obstacle
            with link.clock.passing():  # for others, also where the caller is late
                link.wait(may_ask, link.earlier(ASK_AGAIN_S, until_s))
            if until_s is not None and link.clock.monotonic_s() >= until_s:
                raise ControlLost(f"control was not given in time: {obstacle}", where=link.name)
        if reported:
            link.log.info("in control")

    def _take_in_earlier_packets(self, until_s: float | None) -> None:
        # packets from before the grant may arrive after its answer: they show what others have changed
        link = self._link
        if not link.wait(lambda: self._was_named or not self.held, link.earlier(NAMED_WITHIN_S, until_s)):
            link.log.warning("in control, but the scheduler's packets are late: settings of others may be unseen")

    def release_inherited(self) -> None:
        """Release control held since before a restart of the component, unless the component needs control now."""
        state = self._link.view.control
        if state is not None and state.holder == self._link.name and not self._wanted and not self.held:
            self._link.send_only(ControlRequest.RELEASE_CTRL)

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Keep control in the block, also while a limit on time lets it wait."""
        self._keeping += 1
        try:
            yield
        finally:
            self._keeping -= 1

    def wait_for_limit(self, again_ns: int, until_s: float | None) -> bool:
        """Wait until a limit on time allows a request; return whether it does, or control or a problem ends the wait.

        Control is given back meanwhile, unless a block keeps it. A flagged problem ends a wait without control: its
        solver may need the microscope for long, and the caller waits for control like all others.
        """
        link, view, again_s = self._link, self._link.view, again_ns * 1e-9
        if not self._keeping:
            self.leave()

        def is_over() -> bool:
            flagged = view.control is not None and bool(view.control.problems)
            return not self.held if self._keeping else flagged and not self._solving

        with link.clock.passing(), link.clock.late(again_s):
            while not is_over() and (left_s := again_s - link.clock.now_s()) > 0.0:
                link.wait(is_over, link.earlier(link.clock.real_s(left_s), until_s))
                if until_s is not None and link.clock.monotonic_s() >= until_s:
                    return is_over() or link.clock.now_s() >= again_s
        return True

    def leave(self) -> None:
        """Release control, if held, without waiting for the answer."""
        if self.held and not self._link.ended:
            self._link.send_only(ControlRequest.RELEASE_CTRL)
        self.held = False

    def lost(self, why: str) -> None:
        """Record the loss of control, and its reason."""
        self.held = False
        self.why_lost = why

    def obstacle(self, solving: int = Problem.NONE) -> str:
        """Return the obstacle to control now, as text for people; empty without an obstacle, or if unknown."""
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

    @property
    def _solving(self) -> int:
        return self._wanted[-1] if self._wanted else Problem.NONE

    def _ask(self, solving: int, until_s: float | None) -> str | None:
        # returns why control must be waited for; None once it is held
        link = self._link
        try:
            response = link.request(ControlRequest.REQUEST_CTRL, int(solving), until_s=until_s)
        except (NoResponse, KeyboardInterrupt):
            # it may be granted all the same: without a release no other component would get control any more
            self.gives_back_inherited = True
            if not link.ended:
                link.send_only(ControlRequest.RELEASE_CTRL)
            raise
        if response.ok:
            # the published state with this holder may arrive before the answer
            self.tenures += 1
            self.held, self._was_named = True, link.view.control is not None and link.view.control.holder == link.name
            return None
        if response.code not in WAIT_FOR_CONTROL:
            raise Refused(response.code, response.reason or "control was refused", where=link.name)
        if solving and response.code == ControlResponse.WRONG_EXP_PROBLEM and not self._is_flagged(solving):
            raise ControlLost(f"{self._name(solving)} is not flagged: there is nothing to solve", where=link.name)
        return response.reason or self.obstacle(solving)

    def _when_changed(self, solving: int) -> Callable[[], bool]:
        view, version = self._link.view, self._link.view.count("ControlState")

        def may_ask() -> bool:
            # then the answer to a request says for certain that it is solved
            is_solved = bool(solving) and not self._is_flagged(solving)
            return view.count("ControlState") != version and (is_solved or not self.obstacle(solving))

        return may_ask

    def _is_flagged(self, problem: int) -> bool:
        state = self._link.view.control
        return state is not None and problem in state.problems

    def _name(self, problem: int) -> str:
        return self._problems.name(problem) if problem else "no problem"

    def _on_packet(self, packet: Packet, ours: bool) -> None:
        state = self._link.view.control  # the view takes a packet before its listeners
        if not ours or not packet.envelope.startswith("ControlState") or state is None:
            return
        if not self.held:
            if self.gives_back_inherited:
                self.release_inherited()
        elif state.holder == self._link.name:
            self._was_named = True
        elif self._was_named:
            self.lost(self.obstacle(self._solving) or "it was revoked")

    def _is_revoked(self, until_s: float | None) -> bool:
        link = self._link
        link.log.error("an error ended a block that had switched the feedback off: the tip is left to the scheduler")
        if not link.request(LEASE_REQUEST, LEASE_AT_ONCE_S, until_s=until_s).ok:
            return False
        view = link.view
        link.wait(lambda: view.control is not None and view.control.holder != link.name, until_s)
        return True

    @property
    def _has_switched_off(self) -> bool:
        return self._is_off and not self._was_off

    @property
    def _is_off(self) -> bool:
        view = self._link.view
        if self.switched is not None and self.switched[0] == view.count(FEEDBACK.name):
            return not self.switched[1]
        return view.feedback is not None and view.feedback.on is False

    def _end_block(self, *, quietly: bool, in_danger: bool = False) -> None:
        # `quietly`: another exception is on its way, and must not be replaced
        self._wanted.pop()
        if self._wanted or not self.held:
            return
        self.held = False
        link = self._link
        try:
            # a refusal (control was lost already) is fine; after a failure, wait only a short time
            with link.interrupts.heeded(), link.interrupts.deferred() if quietly else nullcontext():
                until_s = link.until(link.request_timeout_s if quietly else None)
                if not (in_danger and self._is_revoked(until_s)):
                    link.request(ControlRequest.RELEASE_CTRL, until_s=until_s)
        except (NoResponse, ExperimentEnded, StopRequested):
            if not quietly:
                raise
