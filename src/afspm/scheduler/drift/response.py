"""The response to a registered scan: flags, scans to be taken again, a rate handed over."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from afspm.logic.events import Announced, Effect, Input, Log, ProblemSeen
from afspm.logic.scheduler_core import OwnEnd, SchedulerCore
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Parameter,
    Problem,
    Request,
    RescanKind,
    Response,
    names,
)
from afspm.plain_data import Plain
from afspm.scheduler.drift.forecast import CurrentForecast
from afspm.scheduler.drift.frame import DriftFrame
from afspm.scheduler.drift.messages import DriftCodec, Registered, RescanWanted, ScanJob, Worker
from afspm.scheduler.drift.settings import DriftCompensationSettings
from afspm.scheduler.drift.tally import LATELY, RegistrationTally

RESCAN = "DriftRescan"
_DRIFT, _MALFUNCTION = int(Problem.THERMAL_DRIFT), int(Problem.DEVICE_MALFUNCTION)
_MOST_UNREGISTERED = 3
"""So many scans in a row that nobody could register are as good as a sample that is lost: that of the trackers."""
_AT_START = "a scan in the other direction gives the velocity of the drift"

Step = Callable[[Input], list[Effect]]


class DriftResponse:
    """Decides what is to be done; `step` has the scheduler do it.

    Args:
        name: of the scheduler, in which it flags problems.
    """

    def __init__(
        self,
        settings: DriftCompensationSettings,
        core: SchedulerCore,
        codec: DriftCodec,
        frame: DriftFrame,
        knowledge: CurrentForecast,
        tally: RegistrationTally,
        worker: Worker,
        name: str,
    ) -> None:
        self._settings = settings
        self._core = core
        self._codec = codec
        self._frame = frame
        self._knowledge = knowledge
        self._tally = tally
        self._worker = worker
        self._name = name
        self._started = settings.at_start == "nothing"
        self._unregistered = 0
        self._given_m_s = [0.0, 0.0]

    def of(self, registered: Registered, job: ScanJob, step: Step, now_ns: int) -> list[Effect]:
        """Respond to a scan after it was published. A person's scan is followed, and not scanned again."""
        self._unregistered = 0
        if not self._knowledge.corrects(now_ns * 1e-9):
            self._started = True  # until it is corrected there is time enough to learn the velocity
            return []
        if self._core.control.mode is ControlMode.MANUAL:
            return self._found(step) if registered.matched and not registered.lost else []
        if registered.lost:
            return self._lost(f"the sample is lost: {registered.reason}", step, now_ns)
        if not self._started:
            return self._begin(job.upwards, step, now_ns)
        if self._tally.exceeds(self._settings.most_unregistered):
            return self._too_few(step, now_ns)
        effects = self._found(step) if registered.matched else []
        if registered.rescan:
            effects += self._want(RescanKind.AGAIN, registered.rescan, step, now_ns)
        return effects

    def unregistered(self, why: str, step: Step, now_ns: int) -> list[Effect]:
        """Respond to a scan that was published as predicted, since it could not be registered."""
        if not self._knowledge.corrects(now_ns * 1e-9) or self._core.control.mode is ControlMode.MANUAL:
            return []
        self._unregistered += 1
        if self._unregistered < _MOST_UNREGISTERED:
            exceeds = self._tally.exceeds(self._settings.most_unregistered)
            return self._too_few(step, now_ns) if exceeds else []
        self._unregistered = 0  # who goes on in spite of it is told again after as many
        self._tally.judge_anew()
        return self._lost(f"{_MOST_UNREGISTERED} scans in a row could not be registered: {why}", step, now_ns)

    def give_up(self, step: Step) -> list[Effect]:
        """Nothing will be registered any more: a person has to look, and says so by removing the problem."""
        return step(ProblemSeen(_MALFUNCTION, flagged=True, name=self._name))

    @property
    def is_given_up(self) -> bool:
        """True while that problem is flagged."""
        return _MALFUNCTION in self._core.control.problems

    def _too_few(self, step: Step, now_ns: int) -> list[Effect]:
        """Too many of the last scans lie where they were predicted: the prediction is not to be relied on."""
        self._tally.judge_anew()  # the share counts again from here, should it go on in spite of it
        share = f"more than {self._settings.most_unregistered:.0%} of the last {LATELY} scans were not registered"
        return self._lost(f"{share}: {self._tally.summary()}", step, now_ns)

    def _lost(self, why: str, step: Step, now_ns: int) -> list[Effect]:
        """Nobody scans on, but for whoever searches."""
        searching = self._core.control.solving == _DRIFT
        effects = step(ProblemSeen(_DRIFT, flagged=True, name=self._name))
        # whoever searches already has widened the region: it is that of the scans before which was asked for
        return effects if searching else effects + self._want(RescanKind.SEARCH, why, step, now_ns)

    def _begin(self, upwards: bool | None, step: Step, now_ns: int) -> list[Effect]:
        """The first scan is there: nobody goes on before it has been taken in the other direction."""
        self._started = True
        if upwards is None:
            why = f"the microscope does not report {names.SCAN_DIRECTION}"
            return [Log("INFO", f"{why}: the first scan is not taken in both directions")]
        told = "thermal-drift is flagged until the first scan was taken in both directions: normal at the start"
        effects = [Log("INFO", told), *step(ProblemSeen(_DRIFT, flagged=True, name=self._name))]
        return effects + self._want(RescanKind.OPPOSITE, _AT_START, step, now_ns, upwards=not upwards)

    def _found(self, step: Step) -> list[Effect]:
        """Remove a flag of ours; but who is in control to solve it first puts right what it changed for that."""
        control = self._core.control
        if control.problems.get(_DRIFT) != self._name or control.solving == _DRIFT:
            return []
        return step(ProblemSeen(_DRIFT, flagged=False, name=self._name))

    def _want(
        self, kind: RescanKind, reason: str, step: Step, now_ns: int, *, upwards: bool | None = None
    ) -> list[Effect]:
        place = self._frame.region.current
        if place is None:
            return [Log("ERROR", f"{reason}, and the region to scan again is unknown")]
        wanted = RescanWanted(kind, place.said, self._frame.shape, reason, now_ns, upwards)
        level = "INFO" if kind is RescanKind.OPPOSITE else "WARNING"  # one belongs to the beginning of every night
        return [
            Log(level, f"requesting a rescan: {reason}"),
            *step(Announced(RESCAN, self._codec.encode_rescan(wanted))),
        ]

    # --- a controller that compensates by itself ---

    def begin_compensation(self, now_s: float) -> list[Effect]:
        """Have the controller compensate what we reckon with: nothing at first, whatever the night before has left."""
        compensate = self._settings.compensate
        if compensate is None:
            return []
        effects: list[Effect] = []
        for axis, value_m_s in zip((compensate.x, compensate.y), self._given_m_s, strict=True):
            effects += self._core.ask_own(self._set(axis, value_m_s), now_s, self._told(axis))
        return effects

    def hand_over(self, now_s: float, now_ns: int) -> list[Effect]:
        """Tell the controller the newest rate, if there is one beyond what it has been told; nothing is changed under
        the hands of a person."""
        if self._core.control.mode is ControlMode.MANUAL:
            return []
        compensate, time_s = self._settings.compensate, now_ns * 1e-9
        predicted = self._knowledge.predicted(time_s)
        if compensate is None or predicted is None or not self._knowledge.corrects(time_s):
            return []
        sd_m_s = np.sqrt(np.diagonal(predicted.rate_covariance))
        if np.hypot(*predicted.rate_m_s) <= np.hypot(*sd_m_s):
            return []
        effects: list[Effect] = []
        for axis, name in enumerate((compensate.x, compensate.y)):
            value_m_s = float(self._given_m_s[axis] + predicted.rate_m_s[axis])
            effects += self._core.ask_own(self._set(name, value_m_s), now_s, self._answered(axis, name, value_m_s))
        return effects

    def _set(self, name: str, value_m_s: float) -> Request:
        parameter = Parameter(name, f"{value_m_s:.9g}", "m/s")
        return Request(int(ControlRequest.PARAM), parameter, self._codec.encode(parameter))

    def _told(self, name: str) -> OwnEnd:
        return lambda response, now_s, now_ns: _refusal(name, response)

    def _answered(self, axis: int, name: str, value_m_s: float) -> OwnEnd:
        """Each axis by itself: the controller may take one and refuse the other."""

        def ended(response: Response, now_s: float, now_ns: int) -> list[Effect]:
            if not response.ok:
                return _refusal(name, response)
            self._given_m_s[axis] = value_m_s
            self._worker.compensated(now_ns * 1e-9, (self._given_m_s[0], self._given_m_s[1]))
            return []

        return ended

    # --- over a kill ---

    def to_dict(self) -> Plain:
        """As plain JSON."""
        return {"started": self._started, "unregistered": self._unregistered, "given_m_s": self._given_m_s}

    def restore(self, plain: Plain) -> None:
        self._started, self._given_m_s = bool(plain["started"]), [float(v) for v in plain["given_m_s"]]
        self._unregistered = int(plain["unregistered"])


def _refusal(axis: str, response: Response) -> list[Effect]:
    if response.ok or response.code == ControlResponse.NOT_FREE:
        return []  # a scan has begun already: it is handed over after the next
    return [Log("ERROR", f"the controller refused the drift rate, {axis}: {response.reason}")]
