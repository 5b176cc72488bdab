"""The cast: components that work well together, and disruptive ones."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any

from afspm import wire
from afspm.model import (
    RELAY_REQUEST,
    RESTART_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Parameter,
    ProbePosition,
    Problem,
    ProcessState,
    ProcessStates,
    Region,
    RegionChange,
    RelayedMessage,
    ScanParameters,
    ScopeState,
    names,
)
from tests.simulation.client import Client, Doing

_OK = int(ControlResponse.SUCCESS)
_IN_THE_MIDDLE = Region((0.0, 0.0), (1e-6, 1e-6))


class Experiment(Client):
    """Scans over and over; waits for control, and survives losing it.

    Attributes:
        done: number of complete scans, over all restarts.
    """

    done = 0

    def behave(self) -> Doing:
        yield from self.until(lambda: self.scope is not ScopeState.UNDEFINED, 10.0)
        while True:
            if not (yield from self.regain(Problem.NONE)):
                continue
            yield from self.scan()
            if self.timeline.chance(0.3):
                yield from self.ask(ControlRequest.RELEASE_CTRL)
                yield from self.sleep(self.some(120.0))

    def regain(self, solving: int) -> Generator[float, None, bool]:
        """Request control; after a refusal, wait for a change of control."""
        before = self.control
        response = yield from self.ask(ControlRequest.REQUEST_CTRL, int(solving))
        if response.code == _OK:
            return True
        yield from self.until(lambda: self.control != before, self.some(600.0))
        return False

    def scan(self) -> Doing:
        """One scan, to its end or to the loss of control."""
        yield from self.until(lambda: self.scope is ScopeState.FREE, 5.0)
        count = len(self.scans)
        bias_v = "1.0" if self.timeline.chance(0.95) else "50.0"  # the latter is refused
        set_ = yield from self.ask(ControlRequest.PARAM, Parameter(names.TIP_BIAS_VOLTAGE, bias_v, "V"))
        if set_.code != _OK:
            yield from self.sleep(self.some(20.0))
            return
        begun = yield from self.ask(ControlRequest.ACTION, names.START_SCAN)
        # the place has drifted out of the region that is allowed
        if begun.code in (
            ControlResponse.ACTION_ERROR,
            ControlResponse.PARAM_ERROR,
        ):
            yield from self.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(_IN_THE_MIDDLE))
        if begun.code != _OK:
            yield from self.sleep(self.some(20.0))
            return
        yield from self.until(lambda: self.scope is ScopeState.SCANNING, 5.0)
        yield from self.until(lambda: self.scope is not ScopeState.SCANNING or not self._holds(), self.some(4000.0))
        yield from self.until(lambda: self.scope is ScopeState.FREE, 5.0)
        if len(self.scans) > count:
            self.done += 1

    def _holds(self) -> bool:
        return self.control.holder == self.identity


class ExperimentWithoutIds(Experiment):
    """The same, without ids: a request without an answer is not repeated."""

    knows_ids = False


class Classifier(Client):
    """Flags the tip when the scans are bad, and now and then another problem; clears flags now and then."""

    problems: tuple[int, ...] = (Problem.TIP_SHAPE_CHANGED, Problem.FEEDBACK_NON_OPTIMAL)

    def behave(self) -> Doing:
        seen = 0
        while True:
            yield from self.until(lambda n=seen: len(self.scans) > n, self.some(600.0))  # type: ignore[misc]
            bad = any(not scan.tip_is_good for scan in self.scans[seen:])
            seen = len(self.scans)
            if bad:
                yield from self.ask(ControlRequest.ADD_EXP_PRBLM, int(Problem.TIP_SHAPE_CHANGED))
            if self.timeline.chance(0.05):
                yield from self.ask(ControlRequest.ADD_EXP_PRBLM, int(self.timeline.random.choice(self.problems)))
            if self.control.problems and self.timeline.chance(0.1):
                yield from self.ask(ControlRequest.RMV_EXP_PRBLM, self.timeline.random.choice(self.control.problems))


class Corrector(Experiment):
    """Solves one problem: pulses, scans, and clears the flag."""

    problem: int = Problem.TIP_SHAPE_CHANGED

    def behave(self) -> Doing:
        while True:
            yield from self.until(lambda: self.problem in self.control.problems)
            if not (yield from self.regain(self.problem)):
                continue
            for _ in range(3):
                yield from self.until(lambda: self.scope is ScopeState.FREE, 30.0)
                yield from self.ask(ControlRequest.ACTION, names.PULSE)
                if self.timeline.chance(0.5):
                    yield from self.scan()
            yield from self.ask(ControlRequest.RMV_EXP_PRBLM, int(self.problem))
            yield from self.sleep(self.some(10.0))


class FeedbackCorrector(Corrector):
    """Solves the other problem."""

    problem = Problem.FEEDBACK_NON_OPTIMAL


class Greedy(Experiment):
    """Gets control and does not use it."""

    def behave(self) -> Doing:
        while True:
            yield from self.sleep(self.some(3600.0))
            if (yield from self.regain(Problem.NONE)):
                yield from self.sleep(self.some(7200.0))
                yield from self.ask(ControlRequest.RELEASE_CTRL)


class Crasher(Experiment):
    """Gets control, begins an action, and dies; sometimes for good (exit code 0)."""

    def behave(self) -> Doing:
        yield from self.sleep(self.some(1800.0))
        if (yield from self.regain(Problem.NONE)):
            yield from self.ask(ControlRequest.ACTION, names.START_SPEC)
            yield from self.sleep(self.some(20.0))
            self.kill(0 if self.timeline.chance(0.3) else -11)


class Freezer(Experiment):
    """Gets control, and freezes in its block each time; it is killed and restarted."""

    def behave(self) -> Doing:
        while not (yield from self.regain(Problem.NONE)):
            pass
        self.freeze(1e6)
        yield 0.0


class Careless(Experiment):
    """Switches the feedback off for a measurement, and sometimes disappears before it switches the feedback on.

    Attributes:
        gone_s: how long (real) its computer is away then.
    """

    gone_s = 30.0

    def be_away(self, for_s: float) -> None:
        self.banned = True
        self.timeline.after(for_s, setattr, self, "banned", False)
        self.kill(-11)

    def behave(self) -> Doing:
        while True:
            if not (yield from self.regain(Problem.NONE)):
                continue
            yield from self.until(lambda: self.scope is ScopeState.FREE, 5.0)
            yield from self.ask(ControlRequest.PARAM, Parameter(names.FEEDBACK_ON, "off"))
            yield from self.sleep(self.some(300.0))
            if self.timeline.chance(0.4):
                self.be_away(self.gone_s)
            yield from self.ask(ControlRequest.PARAM, Parameter(names.FEEDBACK_ON, "on"))
            yield from self.ask(ControlRequest.RELEASE_CTRL)
            yield from self.sleep(self.some(600.0))


class Burster(Experiment):
    """Sends commands without waiting for answers; each alone is within the limits."""

    def behave(self) -> Doing:
        while True:
            if not (yield from self.regain(Problem.NONE)):
                continue
            for _ in range(self.timeline.random.randint(1, 8)):
                yield from self.until(lambda: self.scope is ScopeState.FREE, 5.0)
                # of two that are the same, the record could not tell one from the other
                for kind, subject in dict.fromkeys(self._wish() for _ in range(self.timeline.random.randint(2, 7))):
                    self.tell(kind, subject)
                yield from self.sleep(2.0 * self.timeline.random.random())
                self.tell(ControlRequest.ACTION, names.STOP_SCAN)
            yield from self.ask(ControlRequest.RELEASE_CTRL)
            yield from self.sleep(self.some(1200.0))

    def _wish(self) -> tuple[int, Any]:
        # sizes and corners are up to twice as large as the limits allow
        chance = self.timeline.random
        at_m, size_m = chance.uniform(-5e-6, 5e-6), chance.uniform(0.2e-6, 8e-6)
        small = Region((at_m / 3, chance.uniform(-1e-6, 1e-6)), (1e-6, 1e-6))
        return chance.choice(
            (
                _setting(names.SCAN_SIZE_X, size_m),
                _setting(names.SCAN_SIZE_Y, size_m),
                _setting(names.SCAN_TOP_LEFT_X, at_m),
                _setting(names.SCAN_TOP_LEFT_Y, at_m),
                _setting(names.SCAN_ANGLE, chance.uniform(-1.5, 1.5)),
                (ControlRequest.SET_SCAN_PARAMS, ScanParameters(small)),
                (ControlRequest.SET_SCAN_PARAMS, ScanParameters(RegionChange(left_m=at_m, width_m=size_m))),
                (ControlRequest.SET_PROBE_POS, ProbePosition((at_m, 0.0))),
                _setting(names.PROBE_POS_X, at_m),
                _setting(names.PROBE_POS_Y, at_m),
                _setting(names.ZCTRL_SETPOINT, chance.uniform(0.5, 2.0)),
                _setting(names.ZCTRL_SETPOINT, chance.uniform(0.5, 2.0)),
                _setting(names.MOVE_SPEED, chance.uniform(0.5e-6, 2e-6)),
                _setting(names.MOVE_SPEED, chance.uniform(0.5e-6, 2e-6)),
                (ControlRequest.ACTION, names.START_SCAN),
                (ControlRequest.ACTION, names.START_SCAN),
            )
        )


def _setting(name: str, value: float) -> tuple[int, Any]:
    return ControlRequest.PARAM, Parameter(name, repr(value), "rad" if name == names.SCAN_ANGLE else None)


class Adjuster(Client):
    """A person who turns one knob again and again, beside the component in control."""

    def behave(self) -> Doing:
        while True:
            yield from self.sleep(self.some(300.0))
            for _ in range(self.timeline.random.randint(1, 4)):
                value = repr(self.timeline.random.uniform(0.5, 2.0))
                self.tell(ControlRequest.PARAM, Parameter(names.ZCTRL_SETPOINT, value))


class Forgetful(Experiment):
    """Repeats the id of an action after more requests than scheduler and translator remember."""

    def behave(self) -> Doing:
        while True:
            if not (yield from self.regain(Problem.NONE)):
                continue
            yield from self.until(lambda: self.scope is ScopeState.FREE, 5.0)
            key = f"{self.identity}/{self.name}-{self.life}/{self._requests + 1}"
            yield from self.ask(ControlRequest.ACTION, names.START_SCAN)
            yield from self.ask(ControlRequest.ACTION, names.STOP_SCAN)
            for _ in range(350):
                if not self._holds():
                    break
                yield from self.ask(ControlRequest.PARAM, Parameter(names.ZCTRL_PGAIN, "1.0"))
            yield from self.ask(ControlRequest.ACTION, names.START_SCAN, key)
            yield from self.ask(ControlRequest.ACTION, names.STOP_SCAN)
            yield from self.ask(ControlRequest.RELEASE_CTRL)
            yield from self.sleep(1e6)  # once is enough, and long enough


class Impostor(Client):
    """Uses the name of another component, and sends commands again and again."""

    connects = False

    def behave(self) -> Doing:
        while True:
            yield from self.sleep(self.some(900.0))
            self.connect()
            yield from self.ask(ControlRequest.REQUEST_CTRL, 0)
            yield from self.ask(ControlRequest.ACTION, names.START_SCAN)
            yield from self.ask(ControlRequest.RELEASE_CTRL)
            self.kill(1)


class Operator(Client):
    """A person who takes over from time to time.

    Attributes:
        put_right: sees to the microscope before the run continues; None: nobody acts at its panel.
        sees_to_it: the chance that this person does so.
    """

    put_right: Callable[[], None] | None = None
    sees_to_it = 1.0

    def behave(self) -> Doing:
        while True:
            yield from self.sleep(self.some(3600.0))
            yield from self.ask(ControlRequest.SET_CONTROL_MODE, int(ControlMode.MANUAL))
            yield from self.sleep(self.some(300.0))
            yield from self.automated()

    def automated(self) -> Doing:
        while True:
            # one who does not see to the microscope is refused, where the controller shows the reason
            if self.put_right is not None and self.timeline.chance(self.sees_to_it):
                self.put_right()
            response = yield from self.ask(ControlRequest.SET_CONTROL_MODE, int(ControlMode.AUTOMATED))
            if response.code == _OK:
                return


class Person(Operator):
    """Attends to a tip that was in danger, at the controller's panel, and clears the malfunction.

    Attributes:
        approach: brings the tip back to the surface.
        comes_s: time until the person comes, experiment time.
        for_people: the problems that only people clear.
    """

    for_people = (Problem.DEVICE_MALFUNCTION, Problem.THERMAL_DRIFT)
    approach: Callable[[], None]
    comes_s = 1200.0

    def behave(self) -> Doing:
        while True:
            yield from self.until(self._is_called)
            yield from self.sleep(self.some(self.comes_s))
            yield from self.see_to_tip()
            if self.put_right is not None and self.control.mode is ControlMode.MANUAL:
                yield from self.automated()

    def see_to_tip(self) -> Doing:
        for problem in set(self.for_people).intersection(self.control.problems):
            self.approach()
            yield from self.ask(ControlRequest.RMV_EXP_PRBLM, int(problem))

    def _is_called(self) -> bool:
        gave_up = self.put_right is not None and self.control.mode is ControlMode.MANUAL
        return gave_up or not set(self.for_people).isdisjoint(self.control.problems)


class Dawn(Person):
    """The person who comes in the morning, attends to the tip, and then may end the experiment.

    Attributes:
        ends: whether to end the experiment.
    """

    ends = False

    def behave(self) -> Doing:
        while self.ends:
            yield from self.ask(ControlRequest.END_EXPERIMENT)
        while True:
            yield from self.automated()
            yield from self.see_to_tip()
            yield from self.until(lambda: self.control.mode is ControlMode.MANUAL or self._is_called())


class Stranger(Client):
    """Sends random requests, allowed or not."""

    requests: tuple[tuple[int, Any], ...] = (
        (ControlRequest.RELEASE_CTRL, None),
        (ControlRequest.RMV_EXP_PRBLM, 2),
        (ControlRequest.ADD_EXP_PRBLM, 0),
        (ControlRequest.ADD_EXP_PRBLM, 77),
        (ControlRequest.REQUEST_CTRL, 77),
        (ControlRequest.SET_CONTROL_MODE, 0),
        (ControlRequest.SET_CONTROL_MODE, int(ControlMode.MANUAL)),
        (ControlRequest.END_EXPERIMENT, None),
        (ControlRequest.ACTION, names.PULSE),
        (ControlRequest.PARAM, Parameter(names.TIP_BIAS_VOLTAGE)),
        (ControlRequest.PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "nan", "V")),
        (ControlRequest.ACTION_SUPPORT, names.PULSE),
        (RESTART_REQUEST, "experiment"),
        (RESTART_REQUEST, "nobody"),
    )

    def behave(self) -> Doing:
        while True:
            yield from self.sleep(self.some(600.0))
            kind, subject = self.timeline.random.choice(self.requests)
            yield from self.ask(kind, subject)


class Babbler(Client):
    """Sends frames that are no request."""

    def behave(self) -> Doing:
        while True:
            yield from self.sleep(self.some(600.0))
            if self._line is not None and self._line.up:
                self._scheduler.take(self._scheduler.peer_sent, self._line, self._frames())

    def _frames(self) -> list[bytes]:
        return self.timeline.random.choice(
            (
                [b"\xff"],
                [b"\x01", b"\xff\xff", f"{self.identity}/x-1/1".encode()],
                [b"", b"", b"", b""],
                [bytes([ControlRequest.END_EXPERIMENT])] * 4,
            )
        )


class Teller(Client):
    """The part of a supervisor that reports process states and carries out orders to restart.

    Attributes:
        processes: returns the process states.
        restart: restarts a process.
        ordered: number of orders received.
    """

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.processes: Callable[[], tuple[ProcessState, ...]] = tuple
        self.restart: Callable[[str], None] = lambda name: None
        self.ordered = 0

    def behave(self) -> Doing:
        while True:
            now_ns = self.timeline.now_ns()
            told = RelayedMessage(
                "ProcessStates", self.codec.encode(ProcessStates(now_ns, self.name, self.processes()))
            )
            response = yield from self.ask(RELAY_REQUEST, told)
            for name in wire.decode_orders(response.payload) if response.code == _OK else ():
                self.ordered += 1
                self.restart(name)
            yield from self.sleep(5.0)


class FeedListener(Client):
    """Receives everything and sends nothing, as a visualiser does."""

    listens = ("",)

    def behave(self) -> Doing:
        while True:
            yield from self.sleep(1e6)
