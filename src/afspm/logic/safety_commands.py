"""What the scheduler asks of the translator by itself: what the watchdog wants, and what kind of translator it is."""

from __future__ import annotations

from afspm.logic.events import Codec, Log
from afspm.logic.forwarder import ForwardedRequest, Forwarder, ForwardOutcome
from afspm.logic.watchdog import SafetyResult, Watchdog
from afspm.model import ControlRequest, ControlResponse, Request, Response

_ID = "scheduler/are-ids-known"


class SafetyCommands:
    """The scheduler's own requests, which go before all others."""

    def __init__(self, forwarder: Forwarder, watchdog: Watchdog, codec: Codec) -> None:
        self._forwarder = forwarder
        self._watchdog = watchdog
        self._codec = codec
        self._question: ForwardedRequest | None = None

    def begin(self, now_s: float) -> None:
        """The translator can be asked: does it retract, and does it know ids (ours do, those of version 1 do not)?"""
        action = self._watchdog.question
        request = Request(int(ControlRequest.ACTION_SUPPORT), action, self._codec.encode_action(action), _ID)
        self._question = self._forwarder.ask_own(request, now_s)
        self._watchdog.translator_is_there(now_s)
        self.send(now_s)

    def send(self, now_s: float) -> None:
        """Send what the watchdog wants."""
        while (action := self._watchdog.next_action()) is not None:
            request = Request(int(ControlRequest.ACTION), action, self._codec.encode_action(action))
            if self._forwarder.ask_own(request, now_s) is None:
                self._watchdog.unsent(now_s)
                return

    def ended(self, job: ForwardedRequest, end: ForwardOutcome, response: Response, now_s: float) -> Log | None:
        """One of these came to its end. Returns what people are to be told if it is not wanted any more."""
        if end is ForwardOutcome.LATE:
            if response.code == ControlResponse.SUCCESS and job.request.kind == ControlRequest.ACTION:
                self._watchdog.done_late(str(job.request.subject))
            return None
        if job is self._question:
            if response.code == ControlResponse.ACTION_NOT_SUPPORTED:
                self._watchdog.cannot_retract()
            return None
        if not self._forwarder.up:
            self._watchdog.unsent(now_s)
            return None
        result = self._watchdog.answered(response.code, now_s)
        self.send(now_s)
        if result is SafetyResult.FAILED:
            due_s = self._watchdog.due_s
            again = "" if due_s is None else f"; it is asked again in {due_s - now_s:.0f} s, unless somebody sees to it"
            why = response.reason or response.code
            return Log("ERROR", f"the microscope does not {job.request.subject}: {why}{again}")
        return Log("INFO", f"{job.request.subject}: done") if result is SafetyResult.DONE else None
