"""The simulated microscope of a bench behind its real translator, which skips idle polls.

**Theory of operation.** A translator polls its controller four times a second, and in a night nearly all polls find
nothing. The translator's polls stay on the times at which they would come if all were made, and the bench makes those
that may find something. A poll is idle if

- the last poll that read all settings came after the last event of the microscope, after the last request and after the
  last subscription, and published nothing;
- the microscope has no event until this poll: neither an end of an activity nor a file, an act at its panel or a fault.
  The simulator computes the time of its next event, which the translator must not learn;
- the translator itself has nothing due: lines of a scan, a deadline, former values to restore.

So each change is found by the poll that would find it if all were made, or not at all if the translator has a fault.
Only polls between two other events are skipped: no other process could tell the difference.
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, get_args

from afspm.basics.errors import ConfigError
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.emulation import Simulator
from afspm.model import ControlRequest, ControlResponse, Request, Response
from afspm.testing.components.hosted_processes import TranslatorProcess
from afspm.testing.components.memory_network import ControlLine
from afspm.testing.components.simulated_time import SimulatedTime
from afspm.transport.port import Served

Polls = Literal["needed", "all", "checked"]
"""Which polls of the microscope a bench makes: "needed" without the idle ones; "checked" makes all, and raises an error
if a poll finds something that "needed" would skip."""

POLLS = "AFSPM_BENCH_POLLS"
"""Environment variable with the polls of benches that do not name theirs."""


class PollWasNotIdle(AssertionError):
    """The error of a bench that would have skipped a poll that found something."""


def polls_from(given: str) -> Polls:
    """Return which polls a bench makes; an empty text: as in the environment.

    Raises:
        ConfigError: there are no such polls.
    """
    known: tuple[Polls, ...] = get_args(Polls)
    text = given or os.environ.get(POLLS, "needed")
    for polls in known:
        if text == polls:
            return polls
    raise ConfigError(f"polls = {text!r}", where="Bench", hint=f"one of {', '.join(known)}")


class BenchMicroscope:
    """The simulated microscope over all lives of its translator, each with a new simulator."""

    def __init__(self, simulator: type[Simulator], settings: PlainMapping) -> None:
        self._class = type(f"Bench{simulator.__name__}", (_DrawsInItsThread, simulator), {})
        self._settings = copy.deepcopy(dict(settings))
        # a class of the user's may answer otherwise at any time
        self._is_known = simulator is Simulator

    def switched_on(self) -> Simulator:
        made: Simulator = self._class(**copy.deepcopy(self._settings))
        self._simulator = made
        return made

    def next_event_s(self) -> float:
        """Return the experiment time until which its answers stay the same without a request; -inf if unknown."""
        at_s = self._simulator.next_event_s() if self._is_known else None
        return -math.inf if at_s is None else at_s

    def change_tip(self, condition: str, now_s: float) -> None:
        self._simulator.change_tip(condition)
        # a translator that is killed before it saves has the change in its next life, too
        changes = dict(self._settings.get("tip_changes") or {})
        changes["schedule"] = [*changes.get("schedule", ()), [now_s, condition]]
        self._settings["tip_changes"] = changes


class _DrawsInItsThread:
    def run_drawing(self, work: Callable[[], None]) -> None:
        work()  # in the thread of the bench: the same seed gives the same run


class BenchTranslator(TranslatorProcess):
    """A translator that skips idle polls, and refuses requests on demand. Pending refusals survive a kill."""

    def __init__(self, timeline: SimulatedTime, microscope: BenchMicroscope, folder: Path, polls: Polls) -> None:
        super().__init__(timeline, microscope.switched_on, folder)
        self._microscope = microscope
        self._polls = polls
        self.refusals: dict[str, tuple[int, str]] = {}

    def connect(self) -> None:
        super().connect()
        self._traffic = 0
        self._is_quiet = False
        self._event_s = -math.inf
        self._kept: Plain = {}

    # --- polls ---

    def timed_out(self) -> None:
        if self._polls == "all":
            super().timed_out()
        elif self._polls == "checked":
            self._poll_and_check()
        elif not self._skip():
            self._poll()

    def _skip(self) -> bool:
        # True: another event comes before the next poll, which waits for its time
        timeline, observer, until_s = self.timeline, self.translator.observer, self._idle_until_s()
        while timeline.monotonic_s() < until_s:
            observer.skip_look()
            wait_s = observer.wait_s()
            if not timeline.advance(wait_s):
                self.wait_again(wait_s)
                return True
        return False

    def _idle_until_s(self) -> float:
        # real time
        if not self._is_quiet:
            return -math.inf
        return min(self.translator.observer.real_time_s(self._event_s), self.translator.idle_until_s())

    def _poll(self) -> None:
        before, now_s = self._evidence(), self.timeline.now_s()
        # The simulated controller catches up with its events when its state is read, which comes after its settings: a
        # poll after an event may have read the settings before it. And a poll that reads the state alone, for new lines
        # of a scan, is no evidence that the settings are the same.
        is_caught_up = now_s < self._microscope.next_event_s()
        is_still_quiet = self._is_quiet and now_s < self._event_s
        sees_all = is_caught_up and (self.translator.observer.reads_settings or is_still_quiet)
        super().timed_out()
        self._is_quiet = self.alive and sees_all and self._evidence() == before
        self._event_s = self._microscope.next_event_s() if self._is_quiet else -math.inf

    def _evidence(self) -> tuple[int, str]:
        return self._traffic, self.memory.saved_text

    def _poll_and_check(self) -> None:
        at_s = self.timeline.monotonic_s()
        if not at_s < self._idle_until_s():
            self._poll()
            self._kept = copy.deepcopy(dict(self.memory)) if self._is_quiet else {}
            return
        foreseen = copy.copy(self.translator.observer)
        foreseen.skip_look()
        self._poll()
        if not self._is_quiet:
            raise PollWasNotIdle(f"the poll at {at_s} s published or saved something, and would be skipped")
        if self.memory != self._kept:
            raise PollWasNotIdle(f"the poll at {at_s} s made the translator's memory {self.memory} from {self._kept}")
        if self.wait_s != foreseen.wait_s():
            raise PollWasNotIdle(f"after the poll at {at_s} s the next comes in {self.wait_s} s, not as foreseen")

    def arrived(self) -> None:
        self._is_quiet = False
        super().arrived()

    def wake(self, incoming: Served | None) -> None:
        self._is_quiet = False
        super().wake(incoming)

    def publish(self, envelope: str, payload: bytes, time_ns: int | None, *, keep: bool) -> None:
        self._traffic += keep  # lines of a running scan follow from no change
        super().publish(envelope, payload, time_ns, keep=keep)

    def reply(self, frames: Sequence[bytes] | None) -> None:
        self._traffic += 1
        super().reply(frames)

    # --- refusals ---

    def peer_asked(self, line: ControlLine, request: Request, number: int) -> None:
        subject = getattr(request.subject, "name", request.subject)
        left, reason = self.refusals.get(subject, (0, "")) if isinstance(subject, str) else (0, "")
        if left and request.kind != ControlRequest.ACTION_SUPPORT:
            self.refusals[subject] = (left - 1, reason)
            line.answer(Response(int(ControlResponse.FAILURE), b"", reason, request.id), number)
        else:
            super().peer_asked(line, request, number)
