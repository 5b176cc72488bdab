"""State of Nanonis, derived from replies of the first connection and events of the second."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar, Final

from afspm.basics import Clock, Refused
from afspm.driver import SCAN, Activity, ControllerLost, ControllerSilent, Kept, as_list, frame
from afspm.model import ControlResponse, Region, ScopeState, ScopeStatus
from afspm.plugins.nanonis.geometry import Probe, ScanFrame
from afspm.plugins.nanonis.parameter_groups import TipState
from afspm.plugins.nanonis.protocol import NanonisError, UnreadableReply
from afspm.plugins.nanonis.result_files import NanonisFiles
from afspm.plugins.nanonis.session import APPROACH, MODULES, CurveEnded, ListenerEvent, ScanEnded, Session

_SHOWS_S: Final = 10.0
"""Longest real time until a poll shows a started scan or curve: the tip may first have to move to the first line."""
_LATEST_S: Final = 10.0
"""Experiment time from the expected arrival of the tip until the move counts as failed."""
SAFE_TIP: Final = "Nanonis' safe tip withdrew the tip: find out why, then run x-engage to bring it back"

WITHDRAWING: Final = "Nanonis is withdrawing the tip"


class NanonisActivity(Activity):
    """Measurements, moves, pulses and tip shaping of one controller.

    Args:
        kept: persistent, JSON-able: state and end time of the last pulse or tip shaping.

    Attributes:
        curve: data of the last ended spectrum; None before the end, and after the data was taken over.
    """

    program: ClassVar[str] = "Nanonis"
    settles_s: ClassVar[float] = 1.0

    def __init__(
        self,
        session: Session,
        files: NanonisFiles,
        probe: Probe,
        tip: TipState,
        kept: Kept,
        clock: Clock,
        log: logging.Logger,
    ) -> None:
        super().__init__(files, clock, log)
        self._ask = session.ask
        self._listener = session.listener
        self._opened = session.opened
        self._files = files
        self._probe = probe
        self._tip = tip
        self._kept = kept
        self.curve: CurveEnded | None = None
        self._kind_asked = ""
        self._reported_path: str | None = None
        self._was_safe = False
        self._shows_until_s = 0.0
        self._unseen_s: float | None = None
        self._unread: set[str] = set()

    # --- start and stop ---

    def begin_scan(self, region: Region) -> None:
        """Register a scan that is started, or that a poll has shown running."""
        self._stopping = False
        self._listener.scan()
        self._files.begin(SCAN, self._session_folder(), {"frame": as_list(region)})
        self._shows_until_s = self._clock.monotonic_s() + _SHOWS_S

    def start_curve(self, kind: str, *, is_saved: bool) -> None:
        """Start a spectrum; the second connection receives its data.

        Args:
            is_saved: False: no file is awaited.

        Raises:
            Refused: with ACTION_ERROR: Nanonis reports an error within `settles_s`.
        """
        self._stopping = False
        self.begin(kind, is_saved=is_saved)
        self._kind_asked = kind
        same_name = ""
        self._listener.curve(MODULES[kind], same_name)
        self._unseen_s = None
        self._await_curve(MODULES[kind])

    def begin(self, what: str, *, is_saved: bool = True) -> None:
        """Register the start of a measurement; a scan gets the frame read from Nanonis."""
        if what == SCAN:
            self.begin_scan(frame(ScanFrame(self._ask).read())[0])
            return
        self.curve = None
        # a spectrum begins right after `status` has found no scan
        facts = {"position": list(self._probe.xy_m(between_scans=True)), **({} if is_saved else {"unsaved": True})}
        self._files.begin(what, self._session_folder(), facts)

    def end(self, path: str | None = None) -> None:
        """Register the end of the measurement.

        Args:
            path: file path reported by Nanonis; empty: not saved; None: not reported.
        """
        self._files.end(self._clock.now_ns(), self._clock.now_s(), path)

    def _await_curve(self, module: str) -> None:
        # Nanonis reports a refused start only as the error of the blocking call on the second connection.
        until_s = self._clock.monotonic_s() + self.settles_s
        while not self._runs(module) and self._clock.monotonic_s() < until_s:
            for event in self._listener.events():
                if isinstance(event, Exception) and not isinstance(event, ControllerLost):
                    self.forget()
                    raise Refused(ControlResponse.ACTION_ERROR, str(event))
                self._take(event)
                return

    def stop_measuring(self) -> None:
        """Stop the running scan or spectrum."""
        if self._files.what == SCAN or self._ask("Scan.StatusGet")[0]:
            self.stop_scan()
        elif self._files.what:
            self.stop_curve()

    def stop_scan(self) -> None:
        stop, no_direction = 1, 0
        self._ask("Scan.Action", stop, no_direction)
        self.stopped()

    def stop_curve(self) -> None:
        """Stop the running spectrum."""
        for module in self._opened.intersection(MODULES.values()):
            is_own = MODULES.get(self._kind_asked) == module
            if self._runs(module) if is_own else self._says(module, "StatusGet"):
                self._ask(f"{module}.Stop")
        self.stopped()

    def forget(self) -> None:
        self._kind_asked = ""
        super().forget()

    @contextmanager
    def occupied(self, state: ScopeState, lasts_s: float) -> Iterator[None]:
        """Register that the action in the `with` block occupies the controller for `lasts_s`, experiment time.

        Nanonis does not report the end of such an action. The occupation persists if the answer, the connection or this
        process is lost; an error reported by Nanonis clears the occupation.
        """
        # stored before the action starts: the action may go on although the answer, or this process, is lost
        self._kept["occupied"] = [state.name, self._clock.now_s() + lasts_s]
        try:
            yield
        except NanonisError:
            self._kept["occupied"] = None
            raise

    @property
    def _occupied(self) -> tuple[ScopeState, float]:
        name, until_s = self._kept.get("occupied") or (ScopeState.FREE.name, 0.0)
        return ScopeState[name], float(until_s)

    def next_change_s(self) -> float | None:
        """Return the time of the next expected change, in experiment time; None: no change is expected.

        Changes are the arrival of the tip, the end of a pulse or tip shaping, and the deadline of an awaited file.
        """
        now_s = self._clock.now_s()
        times = (self._occupied[1], self._probe.arrives_s, self._files.next_s() or 0.0)
        return min((at_s for at_s in times if at_s > now_s), default=None)

    def reports_end(self) -> bool:
        """Return whether the second connection will report the end of the running measurement.

        The beginning of a late scan is not reported.
        """
        is_scan = self._files.what == SCAN
        return self._listener.for_scan and self._files.was_seen if is_scan else self._listener.for_curve

    # --- state ---

    def status(self) -> ScopeStatus:
        """Return the present state; register starts and ends of measurements.

        Raises:
            ControllerLost: a connection failed.
        """
        for event in self._listener.events():
            self._take(event)
        scanning = bool(self._ask("Scan.StatusGet")[0])
        path, self._reported_path = self._reported_path, None
        if scanning:
            return self._scanning(path)
        if self._files.what == SCAN and not self._files.was_seen and not self._files.has_file():
            # The tip may still be moving to the first line; until then, Nanonis' memory holds the last scan.
            if self._clock.monotonic_s() < self._shows_until_s:
                self._listener.scan()  # an earlier event belonged to the scan before
                return ScopeStatus(ScopeState.SCANNING)
            path = None
        if self._files.what == SCAN:
            self._look_for_new_frame()
            self.end(path)
        elif path is not None:  # it comes after the end, perhaps while a spectrum runs
            self._files.scan_reported(self._clock.now_s(), path)
        return self.at_rest(self._besides_scans())

    def refuse_safe_tip(self) -> None:
        """Raise Refused after the safe tip has withdrawn the tip: no measurement is useful then."""
        # `status` has just asked, as before each action: the microscope was free
        if self._tip.is_safe:
            raise Refused(ControlResponse.ACTION_ERROR, SAFE_TIP)

    def stopped_by_hand(self) -> str:
        # the safe tip ends a scan as well
        return "" if self._tip.is_safe else super().stopped_by_hand()

    def _scanning(self, path: str | None) -> ScopeStatus:
        if path and self._is_continuous():  # one frame has ended, the next is running
            self._files.end_followed(self._clock.now_ns(), self._clock.now_s(), path)
        elif path:
            self.end(path)
        self.follow(SCAN)
        if not self._stopping:
            self._files.seen()
            self._listener.scan()
            self._look_for_new_frame()
            if self._watch_safe_tip():
                self.stop_scan()  # the scan may go on in the air, and its picture look plausible
                self._failed = True
        return ScopeStatus(ScopeState.SCANNING)

    def _is_continuous(self) -> bool:
        try:
            return bool(self._ask("Scan.PropsGet")[0])
        except UnreadableReply as error:
            self._log.warning("the scan counts as the only one, and not as a frame of a continuous scan: %s", error)
            return False

    def _look_for_new_frame(self) -> None:
        if self._files.what == SCAN:
            self._files.see_frame(frame(ScanFrame(self._ask).read())[0])

    def _besides_scans(self) -> ScopeState:
        kind = self._kind_running()
        self.follow(kind)
        if kind:
            return ScopeState.SPEC
        state, until_s = self._occupied
        if self._clock.now_s() < until_s:
            return state
        self._watch_safe_tip()
        if self._tip.is_withdrawing or self._approaches():
            return ScopeState.COARSE_MOTOR
        return ScopeState.FREE if self._is_there() else ScopeState.MOVING

    def stop_approach(self) -> None:
        """Stop a running approach, which would bring a withdrawn tip back."""
        if self._approaches() or f"{APPROACH}.OnOffGet" in self._unread:
            off = 0
            self._ask("AutoApproach.OnOffSet", off)

    def _approaches(self) -> bool:
        return self._says(APPROACH, "OnOffGet")

    def _says(self, module: str, question: str) -> bool:
        # an answer that is not vital: if it can't be read it is asked no more, and the contact with Nanonis stays
        if module not in self._opened or (name := f"{module}.{question}") in self._unread:
            return False
        try:
            return bool(self._ask(name)[0])
        except UnreadableReply as error:
            self._unread.add(name)
            self._log.warning("%s is not asked from now on, and what a person does there is not seen: %s", name, error)
            return False

    def _runs(self, module: str) -> bool:
        # a curve whose status can't be read may run
        return self._says(module, "StatusGet") or f"{module}.StatusGet" in self._unread

    def _kind_running(self) -> str:
        # the blocking call on the second connection reports the end of the translator's own spectra
        if self._kind_asked:
            self._require_curve(MODULES[self._kind_asked])
            return self._kind_asked
        for kind, module in MODULES.items():
            if self._says(module, "StatusGet"):
                return kind
        return ""

    def _require_curve(self, module: str) -> None:
        # the blocking call waits for a day, also at a port that accepts the start and answers nothing
        now_s = self._clock.monotonic_s()
        if self._runs(module):
            self._unseen_s = None
        elif self._unseen_s is None:
            self._unseen_s = now_s
        elif now_s - self._unseen_s >= _SHOWS_S:
            self.end()  # a curve whose answer was lost may have a file
            problem = (
                f"{module}.Start has no answer, and for {_SHOWS_S:g} s no curve has run: it never began, or is over"
            )
            raise ControllerSilent(problem, hint="another program may hold the port of blocking calls, or it is wedged")

    def _is_there(self) -> bool:
        if self._probe.arrived():
            return True
        if self._clock.now_s() < self._probe.arrives_s + _LATEST_S:
            return False
        self._log.error("the tip did not reach the position that it was sent to")
        self._probe.give_up()
        return True

    def _watch_safe_tip(self) -> bool:
        # Logged once, not at each poll.
        self._tip.look()
        safe = self._tip.is_safe
        if safe and not self._was_safe:
            self._log.error("Nanonis' safe tip withdrew the tip: nothing is measured until it is engaged again")
        self._was_safe = safe
        return safe

    def _take(self, event: ListenerEvent) -> None:
        if isinstance(event, ScanEnded):
            self._reported_path = event.path
        elif isinstance(event, CurveEnded):
            self._kind_asked, self.curve = "", event
        elif isinstance(event, ControllerLost):
            raise event
        else:
            self._log.error("%s", event)
            if self._kind_asked:
                self._kind_asked = ""
                not_saved = ""
                self.end(not_saved)

    def _session_folder(self) -> str:
        return str(self._ask("Util.SessionPathGet")[0])
