"""The end of the experiment, which waits for the tip to be out of danger."""

from __future__ import annotations

from afspm.logic.events import Log, RequestIn
from afspm.logic.request_pipeline import RequestPipeline
from afspm.logic.settings import SchedulerSettings
from afspm.logic.watchdog import Watchdog
from afspm.model import ControlResponse, ResponseDetail


class ExperimentEnd:
    """Keeps back the answers by which others learn that it is over, until the tip is seen to or that takes too long.

    Who hears that it is over may leave, and the supervisor with it.

    Attributes:
        by_s: when, in real monotonic time, it ends at the latest; None: it does not end, or has ended.
    """

    def __init__(self, settings: SchedulerSettings, desk: RequestPipeline, watchdog: Watchdog) -> None:
        self.by_s: float | None = None
        self._settings = settings
        self._pipeline = desk
        self._watchdog = watchdog
        self._kept: list[tuple[RequestIn, ControlResponse, str, ResponseDetail]] = []

    def begin(self, now_s: float) -> None:
        """The experiment is over."""
        self._watchdog.hurry(now_s)
        self.by_s = now_s + self._settings.request_timeout_s + self._settings.patience_s

    def answer(
        self, event: RequestIn, code: ControlResponse, why: str, detail: ResponseDetail = ResponseDetail.NONE
    ) -> None:
        """Answer a request, now or when the tip is seen to."""
        if self.by_s is None:
            self._pipeline.answer(event, code, why, detail=detail)
        else:
            self._kept.append((event, code, why, detail))

    def is_due(self, now_s: float) -> bool:
        """Whether all may leave now."""
        return self.by_s is not None and not (self._watchdog.owes_retract and now_s < self.by_s)

    def end(self) -> None:
        """Give the answers that were kept back."""
        self.by_s = None
        if self._watchdog.owes_retract:
            danger = "the experiment ends, and the tip was left in danger: the microscope did not retract it"
            self._pipeline.effects.append(Log("CRITICAL", danger))
        for event, code, why, detail in self._kept:
            self._pipeline.answer(event, code, why, detail=detail)
        self._kept.clear()
