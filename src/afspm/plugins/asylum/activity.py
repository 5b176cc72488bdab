"""State of the Asylum controller, and the measurements in progress."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, Final

from afspm.basics import Clock, Refused
from afspm.driver import SCAN, Activity, Kept, TipWay, as_list, as_region
from afspm.model import ControlResponse, Region, ScopeState, ScopeStatus
from afspm.plugins.asylum.result_files import AsylumFiles, Target, free_suffix, local
from afspm.plugins.asylum.session import Session
from afspm.plugins.asylum.xop import MISSING, XopError

FORCE: Final = "force"

_SAVED_TO: Final = {SCAN: "SaveImage", FORCE: "SaveForce"}
"""Asylum's name for saving, by kind of measurement: for GV a number (2: results are saved), for GS the folder."""
_SAVE: Final = 2.0
_WITHDRAWS: Final = "LastScanWithdraw"


class AsylumActivity(Activity):
    """The running measurement, started by a request or at Asylum's panel.

    Args:
        files: collects the results.
        kept: a JSON dict on disk: frame of the image whose corner is the origin of spots, arrival time of the tip, and
            whether a scan has moved the tip away from its spot.
        folders: Igor's folder prefixes; see `local`.
        frame_in_force: returns the frame as it was set.
        spot_m: returns the target position of the tip, (x, y) in m; None: moving the tip is disabled.
        take_curve: starts a force curve.

    Attributes:
        withdrew_tip: why Asylum has withdrawn the tip, or will do so, without a person: empty since the last start.
    """

    program: ClassVar[str] = "Asylum"
    settles_s: ClassVar[float] = 1.0

    def __init__(
        self,
        session: Session,
        files: AsylumFiles,
        kept: Kept,
        folders: Mapping[str, str],
        frame_in_force: Callable[[], Region],
        clock: Clock,
        log: logging.Logger,
        *,
        spot_m: Callable[[], tuple[float, float]] | None,
        take_curve: Callable[[], None],
    ) -> None:
        super().__init__(files, clock, log)
        self._session = session
        self._files = files
        self._kept = kept
        self._folders = folders
        self._frame_in_force = frame_in_force
        self._spot_m, self._take_curve = spot_m, take_curve
        self.way = TipWay(kept, clock)
        self.withdrew_tip = ""
        self._is_under_way = False

    def status(self) -> ScopeStatus:
        """Return the present state. Register measurements that began or ended, and take a curve that awaits the tip."""
        state = self._session.doing().state
        if self.curve_awaited:
            return self._arriving(state)
        self.follow({ScopeState.SCANNING: SCAN, ScopeState.SPEC: FORCE}.get(state, ""))
        if state is ScopeState.SCANNING:
            self._image_begins()
        if state is not ScopeState.FREE:
            return ScopeStatus(state)
        return ScopeStatus(ScopeState.MOVING) if self.way.is_on else self.at_rest()

    def _arriving(self, state: ScopeState) -> ScopeStatus:
        if state is ScopeState.FREE and self.way.is_on:
            return ScopeStatus(ScopeState.SPEC)
        self.curve_awaited = ""
        if state is not ScopeState.FREE:
            return self.fail("the force curve was not taken: another measurement began while the tip moved")
        try:
            self._take_curve()
        except Refused as refused:
            return self.fail("the force curve was not taken: %s", refused.reason)
        return ScopeStatus(ScopeState.SPEC)

    @property
    def image(self) -> Region:
        """The frame of the last image, whose lower left corner is the origin of Asylum's spots."""
        return as_region(self._kept["image"])

    def find_image(self) -> None:
        """Use the present frame as the open image's frame, unless a frame is already stored."""
        self._kept.setdefault("image", as_list(self._frame_in_force()))

    def _image_begins(self) -> None:
        # only once a poll shows the scan running: a scan that does not start leaves the previous image open, and its
        # spots valid
        if (frame := self._files.frame) is None:
            return
        self._kept["image"] = frame
        if not self._is_under_way:
            self._is_under_way = True
            self._look_at_frame()

    def begin(self, what: str) -> None:
        """Register the start of a scan, or of a force curve at the panel.

        The position of such a curve is later read from its file.
        """
        self.withdrew_tip, self._is_under_way = "", False
        taken: dict[str, object] = {"position": None}
        if what == SCAN:
            # only if the tip was ever sent to a spot: else a force curve is taken at the present position
            if "led_away" in self._kept:
                self._kept["led_away"] = True
            taken = {"frame": as_list(self._frame_in_force())}
        self._files.begin_at(what, self._target(what), taken)

    def begin_curve(self) -> None:
        """Register the start of a requested force curve at the tip's target spot."""
        spot_m = None if self._spot_m is None else list(self._spot_m())
        self._files.begin_at(FORCE, self._target(FORCE), {"position": spot_m})

    def end(self) -> None:
        if self._files.what == SCAN:
            self._look_at_frame()
            if self._withdraws_after_scan():
                self.withdrew_tip = "Asylum withdrew the tip after the scan, as its LastScanWithdraw says"
        self._files.end(self._clock.now_ns())

    def see_frame(self, region: Region) -> None:
        """Register a frame that was read; it counts while a scan is seen running."""
        if self._is_under_way:
            self._files.see_frame(region)

    def _look_at_frame(self) -> None:
        # which calls `see_frame`. In a mode without these values the frame of the file decides
        with suppress(Refused):
            self._frame_in_force()

    def withdraw(self) -> None:
        """Press *Stop*, which ends what runs, and withdraws the tip."""
        # the tip goes up for a while after the answer
        self.withdrew_tip = "the tip was withdrawn by a stop on request"
        self._session.do("DoScanFunc", "StopScan")
        self.stopped()

    def _withdraws_after_scan(self) -> bool:
        try:
            return bool(self._session.values([_WITHDRAWS])[_WITHDRAWS])
        except Refused:
            return False  # this release has no such value

    def saves(self, what: str) -> None:
        """Switch on saving, and check that the folder is reachable.

        Raises:
            Refused: ACTION_ERROR: the folder does not exist on this computer. ConfigError: see `folder`.
        """
        name = _SAVED_TO[what]
        # the file is the only result: no function used here returns images or curves
        if self._session.values([name])[name] != _SAVE:
            self._log.warning("Asylum did not save its measurements (%s); saving is on from now on", name)
            self._session.put({name: _SAVE})
            if self._session.values([name])[name] != _SAVE:
                reason = f"{name} stays off, although it was set: nothing would be saved. Switch saving on at Asylum"
                raise Refused(ControlResponse.ACTION_ERROR, reason)
        folder = self.folder(what)
        if not folder.is_dir():
            reason = f"Asylum's folder {folder} does not exist on this computer: set folders"
            raise Refused(ControlResponse.ACTION_ERROR, reason)

    def folder(self, what: str) -> Path:
        """Return Asylum's folder for images or curves, as a path on this computer. Raises ConfigError: see `local`."""
        return local(self._session.text("GS", _SAVED_TO[what]), self._folders)

    def call_files(self, base: str) -> None:
        """Set the files' base name, and a number above all existing files of this name: Asylum overwrites files."""
        self._session.do("SetBaseName", base)
        self._session.put({"BaseSuffix": max(free_suffix(self.folder(what), base) for what in _SAVED_TO)})
        try:
            # the panel's own check also sees folders that are not reachable from this computer
            self._session.do("ARCheckSuffix")
        except XopError as error:
            if error.number != MISSING:
                raise

    def await_begin(self, what: str) -> None:
        """Wait until the measurement is running or has a file.

        Raises:
            Refused: ACTION_ERROR: neither happened within `settles_s`.
        """
        state = ScopeState.SCANNING if what == SCAN else ScopeState.SPEC
        self.settle(what, lambda: self._session.doing().state is state or self._files.has_file())
        self._image_begins()

    def refuse(self, what: str) -> Refused:
        """Discard the measurement, and return the refusal (ACTION_ERROR) for a request that Asylum declined."""
        self.forget()
        return Refused(
            ControlResponse.ACTION_ERROR, f"Asylum refused to begin the measurement ({what}): see its history window"
        )

    def moves(self, lasts_s: float) -> None:
        """Register a move of at most `lasts_s`, experiment time; Asylum does not report arrival."""
        self.way.sets_out(lasts_s)
        self._kept["led_away"] = False

    @property
    def was_led_away(self) -> bool:
        """True if a scan has moved the tip away from the requested spot."""
        return bool(self._kept.get("led_away"))

    def _target(self, what: str) -> Target:
        suffix = self._session.values(["BaseSuffix"])["BaseSuffix"]
        return Target(self.folder(what), self._session.text("GetBaseName"), round(suffix))
