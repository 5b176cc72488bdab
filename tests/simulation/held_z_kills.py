"""A z held without feedback, whose translator is killed at any step: `python -m tests.simulation.held_z_kills 200`.

The controller is the simulated one, which goes on when the translator is killed; only what the translator has saved on
disk is there in its next life. A tip that touches the sample leaves a crater in the ground truth of the simulation.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from afspm import wire
from afspm.basics.errors import Refused
from afspm.model import ControlRequest, ControlResponse, Parameter, Request, Response, ScopeState, names
from afspm.simulation.simulator import Simulator
from afspm.storage.memory import Memory
from afspm.testing.components.simulated_time import SimulatedTime
from afspm.translator.parameters import Value
from afspm.translator.translator import Translator, TranslatorRun
from afspm.transport.port import RequestReceived, Served

_LOOK_S = 0.05
_LONGEST_S = 60.0
_SHORT = 35
"""A seed whose hold takes the fewest calls: all is set back, and nothing is refused."""
_SETTINGS = (names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT, names.ZCTRL_PGAIN, names.ZCTRL_IGAIN)


class Killed(BaseException):
    """The end of a translator's process at a call of its controller."""


class Controller(Simulator):
    """The simulated controller, whose state is its own and not on the translator's disk.

    Attributes:
        calls: number of calls so far; two for each, before and after its effect.
        kill_at: the call at which the translator is killed.
        refuses: a parameter that the controller does not take any more.
    """

    memory_is_all: ClassVar[bool] = False

    def __init__(self, own: dict[str, Any], **settings: Any) -> None:
        super().__init__(**settings)
        self._own = own
        self.calls, self.kill_at, self.refuses = 0, -1, ""

    @property
    def memory(self) -> dict[str, Any]:
        return self._own

    @memory.setter
    def memory(self, value: object) -> None: ...

    def _passes(self) -> None:
        self.calls += 1
        if self.calls == self.kill_at:
            raise Killed

    def get(self, vendor: str) -> Value:
        self._passes()
        found = super().get(vendor)
        self._passes()
        return found

    def set(self, values: Mapping[str, Value]) -> None:
        self._passes()
        if self.refuses in values:
            raise Refused(ControlResponse.PARAM_ERROR, "the controller does not take it")
        super().set(values)
        self._passes()

    def move_z(self, z_m: float) -> None:
        self._passes()
        super().move_z(z_m)
        self._passes()

    @property
    def crashes(self) -> int:
        assert self._controller is not None
        return self._controller.instrument.ledger.crashes


class _Port:
    """The network of a translator without a scheduler: keeps the last answer."""

    def __init__(self, clock: SimulatedTime) -> None:
        self.clock = clock
        self.replies: list[list[bytes]] = []

    def poll(self, timeout_s: float | None) -> list[Served]:
        return []

    def waiting_request(self) -> None: ...

    def reply(self, frames: Sequence[bytes] | None) -> None:
        self.replies.append(list(frames or []))

    def is_connected(self, connection: bytes) -> bool:
        return True

    def publish(self, envelope: str, payload: bytes, time_ns: int | None = None, *, keep: bool = True) -> None: ...

    def wake_up(self, incoming: Served | None = None) -> None: ...

    def close(self) -> None: ...


@dataclass
class HoldOutcome:
    """What became of a hold.

    Attributes:
        crashes: how often the tip has touched the sample.
        is_as_before: the feedback is on, with height and settings of before the hold.
        is_withdrawn: the tip is withdrawn, and the feedback off.
        kills: how often the translator was killed.
    """

    crashes: int
    is_as_before: bool
    is_withdrawn: bool
    kills: int


class HeldZNight:
    """A hold with random settings and random kills; equal for equal seeds.

    Args:
        kill_at: the call of the controller at which the translator is killed, once; None: at random, perhaps twice.
    """

    def __init__(self, seed: int, folder: Path, kill_at: int | None = None) -> None:
        self._random = draw = random.Random(seed)
        self._folder = folder
        self._clock = SimulatedTime(seed)
        self._own: dict[str, Any] = {}
        self._kills, self._is_refused = 0, False
        self.setpoint, self.bias = draw.uniform(50e-12, 200e-12), draw.choice((-1, 1)) * draw.uniform(0.05, 0.5)
        self._world: dict[str, Any] = {
            "seed": seed,
            "surface": {"kind": draw.choice(("steps", "lattice"))},
            "feedback": {"mode": "current", "setpoint": self.setpoint},
            "initial": {names.TIP_BIAS_VOLTAGE: f"{self.bias} V"},
        }
        # a hold with its ramps takes 500 to 3,000 calls, and a way back some 200; most settings change in the first
        self._kill_at = [draw.choice((draw.randrange(1, 100), draw.randrange(1, 2000))), draw.randrange(1, 250)]
        if kill_at is not None:
            self._kill_at = [kill_at, -1]
        self._refuses = draw.choice(("", "", "", "", *_SETTINGS, names.FEEDBACK_ON))
        self._live()

    def _live(self) -> None:
        if self._own:
            self.close()
        self.controller = Controller(self._own, **self._world)
        self.port = _Port(self._clock)
        self._memory = memory = Memory(self._folder / "translator.json", synced=False)
        run, log = TranslatorRun(self._folder), logging.getLogger("held-z")
        self.translator = Translator(self.controller, self.port, memory, run, log)

    def close(self) -> None:
        """End the threads that write files."""
        self.controller.close()
        self._memory.close()

    def _look(self) -> None:
        self._clock.run_until(self._clock.monotonic_s() + _LOOK_S)
        self.translator.look()

    @property
    def _state(self) -> ScopeState:
        return self.translator.state.sequence.published.state

    def _until_free(self) -> None:
        until_s = self._clock.now_s() + _LONGEST_S
        self._look()
        while self._state is not ScopeState.FREE:
            assert self._clock.now_s() < until_s, f"the microscope stays {self._state.name}"
            self._look()

    def _ask(self, kind: ControlRequest, subject: object) -> Response:
        self.translator.handle(RequestReceived(wire.encode_request(Request(int(kind), subject))))
        return wire.decode_response(self.port.replies[-1])

    def _set(self, name: str, value: float) -> None:
        self._ask(ControlRequest.PARAM, Parameter(name, repr(value)))

    def _act(self, action: str) -> None:
        self._ask(ControlRequest.ACTION, action)

    def _steps(self) -> None:
        # what a component does in a hold; an answer that refuses is as good as another
        draw = self._random
        self._set(names.HELD_Z_SPEED, draw.uniform(50e-12, 1e-9))
        self._set(names.HELD_Z_ABORT_CURRENT, draw.choice((0.0, 1e-9, 10e-9)))
        self._act(names.HOLD_Z)
        self._set(names.TIP_BIAS_VOLTAGE, draw.choice((0.0, 0.001, 0.01, -self.bias)))
        if draw.random() < 0.5:
            self._set(names.ZCTRL_SETPOINT, draw.choice((1e-12, 10e-9)))
        if draw.random() < 0.5:
            self._set(names.ZCTRL_IGAIN, draw.uniform(1.0, 1e5))
        for offset_m in [draw.uniform(-300e-12, 300e-12) for _ in range(draw.randrange(1, 4))]:
            self._set(names.HELD_Z_OFFSET, offset_m)
            self._until_free()
            for _ in range(draw.randrange(5)):
                self._look()
        self.controller.refuses, self._is_refused = self._refuses, bool(self._refuses)
        self._act(names.RELEASE_Z)
        self._until_free()

    def run(self) -> HoldOutcome:
        """Hold z, with a kill in the hold and another one on the way back, if both are reached."""
        self._look()
        before, z_m = self._settings(), self._z_m()
        self.controller.calls, self.controller.kill_at = 0, self._kill_at[0]
        try:
            self._steps()
        except Killed:
            self._kills = 1
            self._live()
            self.controller.kill_at = self._kill_at[1]
            try:
                self._until_free()
            except Killed:
                self._kills = 2
                self._live()
                self._until_free()
        self.controller.kill_at = -1
        self._until_free()
        shown = self.controller.in_force([names.FEEDBACK_ON, names.ENGAGED])
        is_back = bool(shown[names.FEEDBACK_ON]) and abs(self._z_m() - z_m) < 1e-12 and self._settings() == before
        is_withdrawn = not shown[names.ENGAGED] and not shown[names.FEEDBACK_ON]
        return HoldOutcome(self.controller.crashes, is_back, is_withdrawn and self._is_refused, self._kills)

    def _settings(self) -> dict[str, Value]:
        return self.controller.read(_SETTINGS)

    def _z_m(self) -> float:
        return float(self.controller.in_force([names.TIP_Z])[names.TIP_Z])


def night(seed: int, kill_at: int | None = None) -> HoldOutcome:
    """Return what became of the hold of a seed, see `HeldZNight`."""
    # the thread of a killed life may still write its last line
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        made = HeldZNight(seed, Path(folder), kill_at)
        try:
            return made.run()
        finally:
            made.close()


def every_step(seed: int) -> dict[str, HoldOutcome]:
    """Return what became of the hold of a seed with a kill at each of its calls, from the first to the last."""
    found: dict[str, HoldOutcome] = {}
    while (outcome := night(seed, len(found) + 1)).kills:
        found[f"{seed} killed at {len(found) + 1}"] = outcome
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", type=int, help="holds with random kills; then one with a kill at each of its steps")
    logging.disable(logging.CRITICAL)
    outcomes = {str(seed): night(seed) for seed in range(parser.parse_args().seeds)}
    outcomes |= every_step(_SHORT)
    wrong = {name: one for name, one in outcomes.items() if one.crashes or not (one.is_as_before or one.is_withdrawn)}
    kills = [sum(one.kills == number for one in outcomes.values()) for number in range(3)]
    withdrawn = sum(one.is_withdrawn for one in outcomes.values())
    sys.stdout.write(
        f"{len(outcomes)} holds, killed never, once, twice: {kills}; withdrawn: {withdrawn}; "
        f"crashes: {sum(one.crashes for one in outcomes.values())}; wrong: {wrong}\n"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
