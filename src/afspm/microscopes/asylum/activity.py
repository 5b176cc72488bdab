"""The state of Asylum, and what is awaited of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from afspm.clock import Clock
from afspm.errors import Refused
from afspm.microscopes.asylum.result_files import AsylumFiles, Target, free_suffix, local
from afspm.microscopes.asylum.session import Session
from afspm.microscopes.asylum.xop import MISSING, XopError
from afspm.model import ControlResponse, Region, ScopeState, ScopeStatus
from afspm.translator.result_files import SCAN, as_list, as_region
from afspm.translator.state import Kept

FORCE: Final = "force"

_SETTLES_S: Final = 1.0
"""So long, in real time, what was begun may take to be seen running."""
_SAVED_TO: Final = {SCAN: "SaveImage", FORCE: "SaveForce"}
"""Both a number, of which 2 means that it is saved, and a text, the folder."""
_SAVE: Final = 2.0


class Activity:
    """The measurement that runs at the controller, begun by a request or at its panel.

    Args:
        files: takes what comes of it.
        kept: JSON-able, and lasts: the frame of the image that spots are counted on, until when the tip moves, and
            whether a scan has led it away since.
        folders: see `local`.
        frame_in_force: as it was set.
    """

    def __init__(
        self,
        session: Session,
        files: AsylumFiles,
        kept: Kept,
        folders: Mapping[str, str],
        frame_in_force: Callable[[], Region],
        clock: Clock,
        log: logging.Logger,
    ) -> None:
        self._session = session
        self._files = files
        self._kept = kept
        self._folders = folders
        self._frame_in_force = frame_in_force
        self._clock = clock
        self._log = log
        self._stopping = False
        self._on_arrival: Callable[[], None] | None = None

    def status(self) -> ScopeStatus:
        """Return what it is doing now; what has ended is awaited from here on."""
        state = self._session.doing().state
        if self._on_arrival is not None:
            return self._arriving(self._on_arrival, state)
        what = {ScopeState.SCANNING: SCAN, ScopeState.SPEC: FORCE}.get(state, "")
        if not what:
            self._stopping = False
        if self._files.what not in ("", what):
            self._files.end(self._clock.now_ns())
        if what and not self._stopping and self._files.what != what:
            self.begin(what)
        if what == SCAN:
            self._image_begins()
        if state is ScopeState.FREE and self._clock.now_s() < self._moving_until_s:
            return ScopeStatus(ScopeState.MOVING)
        if state is ScopeState.FREE and self._files.broken_off:
            return ScopeStatus(ScopeState.INTERRUPTED)
        return ScopeStatus(state)

    def _arriving(self, take: Callable[[], None], state: ScopeState) -> ScopeStatus:
        """On the way to where a force curve is to be taken."""
        if state is ScopeState.FREE and self._clock.now_s() < self._moving_until_s:
            return ScopeStatus(ScopeState.SPEC)
        self._on_arrival = None
        if state is not ScopeState.FREE:
            self._log.error("the force curve was not taken: another measurement began while the tip moved")
            return ScopeStatus(ScopeState.INTERRUPTED)
        try:
            take()
        except Refused as refused:
            self._log.error("the force curve was not taken: %s", refused.reason)
            return ScopeStatus(ScopeState.INTERRUPTED)
        return ScopeStatus(ScopeState.SPEC)

    def next_change_s(self) -> float | None:
        """When a move is over."""
        return self._moving_until_s if self._moving_until_s > self._clock.now_s() else None

    @property
    def _moving_until_s(self) -> float:
        """Experiment time; it is remembered, as the tip goes on when the connection is lost."""
        return float(self._kept.get("moving_until_s", 0.0))

    @property
    def image(self) -> Region:
        """The frame of the last image that was begun, which Asylum counts spots on."""
        return as_region(self._kept["image"])

    def find_image(self) -> None:
        """Before anything was scanned, and another frame set: that of the image that is open is in force."""
        self._kept.setdefault("image", as_list(self._frame_in_force()))

    def _image_begins(self) -> None:
        """A scan is seen running: not before, as one that does not begin leaves the image of before."""
        if (frame := self._files.frame) is not None:
            self._kept["image"] = frame

    def begin(self, what: str, position_m: tuple[float, float] | None = None) -> None:
        """A measurement begins, with what is in force now.

        Args:
            position_m: of a force curve, where the tip was sent; None: it is left to the file to know.
        """
        taken: dict[str, object] = {"position": position_m and list(position_m)}
        if what == SCAN:
            if "led_away" in self._kept:  # it was sent somewhere
                self._kept["led_away"] = True
            taken = {"frame": as_list(self._frame_in_force())}
        self._files.begin_at(what, self._target(what), taken)

    def saves(self, what: str) -> None:
        """Have it saved where it can be found.

        Raises:
            Refused: ACTION_ERROR: its folder can't be seen from here.
        """
        name = _SAVED_TO[what]
        if self._session.values([name])[name] != _SAVE:
            self._log.warning("Asylum did not save its measurements (%s); saving is on from now on", name)
            self._session.put(name, _SAVE)
        folder = self.folder(what)
        if not folder.is_dir():
            reason = f"Asylum's folder {folder} does not exist on this computer: set folders"
            raise Refused(ControlResponse.ACTION_ERROR, reason)

    def folder(self, what: str) -> Path:
        """Where Asylum saves to, as seen from here.

        Raises:
            ConfigError: the settings don't say.
        """
        return local(self._session.text("GS", _SAVED_TO[what]), self._folders)

    def call_files(self, base: str) -> None:
        """Have files called so from now on, their numbers following those that are there: Asylum overwrites."""
        self._session.do("SetBaseName", base)
        self._session.put("BaseSuffix", max(free_suffix(self.folder(what), base) for what in _SAVED_TO))
        try:
            self._session.do("ARCheckSuffix")  # as the panel does; it sees folders that can't be seen from here, too
        except XopError as error:
            if error.number != MISSING:
                raise

    def settle(self, what: str) -> None:
        """Wait until what was begun is seen running, or has ended already.

        Raises:
            Refused: ACTION_ERROR: Asylum does not do it, and did not say so.
        """
        state = ScopeState.SCANNING if what == SCAN else ScopeState.SPEC
        until_s = self._clock.monotonic_s() + _SETTLES_S
        while self._clock.monotonic_s() < until_s:
            if self._session.doing().state is state or self._files.has_file():
                self._image_begins()
                return
        self.forget()
        raise Refused(
            ControlResponse.ACTION_ERROR, f"Asylum did not begin the measurement that it was asked for ({what})"
        )

    def refuse(self, what: str) -> Refused:
        """The refusal of what Asylum said that it does not do; nothing comes of it."""
        self.forget()
        return Refused(
            ControlResponse.ACTION_ERROR, f"Asylum refused to begin the measurement ({what}): see its history window"
        )

    def stopped(self) -> None:
        """Note that what is running was told to stop: nothing comes of it."""
        self._stopping, self._on_arrival = True, None
        self.forget()

    def forget(self) -> None:
        """Nothing comes of what was begun."""
        self._files.forget()

    def moves(self, lasts_s: float) -> None:
        """The tip was sent away; it arrives, which Asylum does not tell, after so long at the latest."""
        self._kept["moving_until_s"] = self._clock.now_s() + lasts_s
        self._kept["led_away"] = False

    @property
    def was_led_away(self) -> bool:
        """True if a scan has taken the tip from where it was sent."""
        return bool(self._kept.get("led_away"))

    def takes_on_arrival(self, take: Callable[[], None]) -> None:
        """A force curve is taken when the tip is where it was sent."""
        self._on_arrival = take

    def _target(self, what: str) -> Target:
        suffix = self._session.values(["BaseSuffix"])["BaseSuffix"]
        return Target(self.folder(what), self._session.text("GetBaseName"), round(suffix))
