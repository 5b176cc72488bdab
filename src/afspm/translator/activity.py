"""`Activity`: the measurement that runs in a maker's program, from its start to its file.

Theory of operation. A program is polled (`status`), and most programs do not report that a measurement began or ended.
The life of a measurement is the same with all programs:

| step | by |
| --- | --- |
| start: on request, or at the panel, where only the next poll shows the measurement | `begin`, `follow` |
| settling: a request is answered once a poll shows the measurement running, or its file exists | `settle` |
| end: a poll shows no running measurement any more, and the file is awaited | `follow`, `end` |
| stop on request: the measurement may still run for a moment, counts as no new measurement, has no result | `stopped` |
| interruption or failure: reported once as INTERRUPTED | `at_rest` |

A curve may have to wait until the tip arrives at its position (`curve_awaited`), and a command may last as long as the
measurement itself (`call`). A maker's driver detects a running measurement and records it with the files.

Two makers differ too much to share all of it. Nanonis reports ends over a second connection, and at GXSM a scan may
follow another one between two polls; neither waits in `settle`, since their scans may begin late.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, Final

from afspm.basics.clock import Clock
from afspm.basics.errors import AfspmError, Refused
from afspm.basics.plain_data import Plain
from afspm.model import ControlResponse, ScopeState, ScopeStatus
from afspm.translator.long_call import LongCall
from afspm.translator.result_files import SCAN, ResultFiles

_MOST_REFUSALS: Final = 2
"""Refusals of a start that may be a person's doing: the program does not report what a person lets it do, such as a
sweep, nor a scan stopped at the panel within its first poll. The client asks again after some seconds."""

_ENDS_WITHIN_S: Final = 5.0
"""Real time from a stop until a measurement that goes on is an error: a line may have to be finished first."""
_DEAF: Final = "%s measures on %g s after the stop: stop it at the panel; until its end nothing is begun"


class Activity(ABC):
    """A running measurement, started by a request or at the program's panel.

    Args:
        files: the awaited results.

    Attributes:
        call: the command that lasts as long as its measurement; None without one.
        curve_awaited: the kind of the curve that starts once the tip has arrived; empty: none.
    """

    program: ClassVar[str]
    """The name of the program, for messages."""
    settles_s: ClassVar[float] = 0.0
    """Longest real time until a started measurement is running."""
    call_failures: ClassVar[tuple[type[AfspmError], ...]] = ()
    """The errors that a failed `call` raises."""

    def __init__(self, files: ResultFiles, clock: Clock, log: logging.Logger) -> None:
        self._results = files
        self._clock = clock
        self._log = log
        self._stopping = self._failed = False
        self._refusals = 0
        self._deaf_s = math.inf
        self._why_last_ended = ""
        self.call: LongCall | None = None
        self.curve_awaited = ""

    # --- what a maker's driver adds ---

    @abstractmethod
    def begin(self, what: str) -> None:
        """Record the start of a measurement and its settings. `what` is `SCAN`, or the kind of a curve."""

    @abstractmethod
    def end(self) -> None:
        """Record the end of the measurement, and expect its result from now on."""

    @abstractmethod
    def status(self) -> ScopeStatus:
        """Return the present state of the program. Raises ControllerLost."""

    # --- the life of a measurement ---

    def follow(self, what: str) -> None:
        """Compare with the program: record the end of a measurement, and the start of a measurement at the panel.

        Args:
            what: `SCAN`, the kind of a curve, or empty.
        """
        if not what:
            self._stopping = False
        elif self._stopping and self._clock.monotonic_s() >= self._deaf_s:
            self._deaf_s = math.inf
            self._log.error(_DEAF, self.program, _ENDS_WITHIN_S)
        if self._results.what not in ("", what):
            self.end()
        if what and not self._stopping and self._results.what != what:
            self._why_last_ended = self.stopped_by_hand() if self._results.next_begins() else ""
            self.begin(what)

    def settle(self, what: str, is_seen: Callable[[], bool]) -> None:
        """Wait until the started measurement is running, or has already produced its file.

        Raises:
            Refused: ACTION_ERROR: the program did not start the measurement within `settles_s`, and reported no error.
        """
        # without a pause: each look takes as long as the program's answer
        until_s = self._clock.monotonic_s() + self.settles_s
        while self._clock.monotonic_s() < until_s:
            if is_seen():
                return
        self.forget()
        named = what if what == SCAN else f"{what} curve"
        reason = f"{self.program} did not begin the {named} that it was asked for"
        raise Refused(ControlResponse.ACTION_ERROR, reason)

    def started(self, what: str, do: Callable[[], object], is_seen: Callable[[], bool]) -> None:
        """Begin a measurement on request.

        Raises:
            Refused: the measurement was not started. The first `_MOST_REFUSALS` in a row are NOT_FREE.
        """
        self._stopping, self._why_last_ended = False, ""
        self.begin(what)
        try:
            do()
            self.settle(what, is_seen)
        except Refused as refused:
            self.forget()
            raise self.not_started(refused) from refused
        self._refusals = 0

    def not_started(self, refused: Refused) -> Refused:
        """Return the refusal of a start: NOT_FREE instead for the first `_MOST_REFUSALS` in a row."""
        self._refusals = (self._refusals + 1) % (_MOST_REFUSALS + 1)
        return Refused(ControlResponse.NOT_FREE, refused.reason) if self._refusals else refused

    def stopped(self) -> None:
        """Record that a request has stopped the measurement, which has no result."""
        self._stopping, self.curve_awaited = True, ""
        self._deaf_s = self._clock.monotonic_s() + _ENDS_WITHIN_S
        self._results.forget()

    def forget(self) -> None:
        self._results.forget()

    def stopped_by_hand(self) -> str:
        """Return what shows that a person ended the measurement just interrupted; empty: nothing does.

        A measurement that a request has stopped is forgotten, so that nothing of it is known to be missing.
        """
        missing = self._results.missing
        return f"{self.program} ended it without a request of the run, and {missing}" if missing else ""

    def why_ended(self) -> str:
        """Return `stopped_by_hand` of the measurement before the running one, once; else of the last one."""
        found, self._why_last_ended = self._why_last_ended, ""
        return found or self.stopped_by_hand()

    def at_rest(self, state: ScopeState = ScopeState.FREE) -> ScopeStatus:
        """Return the state while nothing is measured.

        INTERRUPTED replaces `state` once after a failed call, and while `broken_off` is True.
        """
        failed, self._failed = self._failed, False
        return ScopeStatus(ScopeState.INTERRUPTED if failed or self._results.broken_off else state)

    def fail(self, reason: str, *values: object) -> ScopeStatus:
        """Log why a request failed, and return the state INTERRUPTED."""
        self._log.error(reason, *values)
        return ScopeStatus(ScopeState.INTERRUPTED)

    # --- commands that take as long as what they do ---

    def watched_call(self) -> LongCall | None:
        """Return the running call, or None; log a failed call.

        Raises:
            ControllerLost
        """
        call = self.call
        if call is None:
            return None
        try:
            if call.running():
                return call
        except self.call_failures as error:
            self._log.error("the %s failed: %s", call.what, error)
            self._failed, self.curve_awaited = True, ""
            if call.what == self._results.what:
                self.forget()
        self.close()
        return None

    def watch(self, call: LongCall) -> None:
        self.close()
        self.call = call

    def close(self) -> None:
        """Stop waiting for the call."""
        if self.call is not None:
            self.call.close()
            self.call = None


class TipWay:
    """The expected arrival of the tip at its target, for programs that do not report arrival.

    Args:
        kept: a JSON dict on disk: the tip moves on after the connection is lost.
    """

    def __init__(self, kept: Plain, clock: Clock) -> None:
        self._kept, self._clock = kept, clock

    @property
    def arrives_s(self) -> float:
        """The latest arrival, in experiment time."""
        return float(self._kept.get("arrives_s", 0.0))

    def sets_out(self, lasts_s: float, *, after_last_way: bool = False) -> None:
        """Record a move of `lasts_s` that starts now, or after the present move (`after_last_way`)."""
        now_s = self._clock.now_s()
        self._kept["arrives_s"] = (max(now_s, self.arrives_s) if after_last_way else now_s) + lasts_s

    def give_up(self) -> None:
        """Record that the tip has stopped."""
        self._kept["arrives_s"] = 0.0

    @property
    def is_on(self) -> bool:
        """True while the tip may be moving."""
        return self._clock.now_s() < self.arrives_s

    @property
    def next_s(self) -> float | None:
        """The time of the arrival while the tip may be moving; None otherwise."""
        return self.arrives_s if self.is_on else None
