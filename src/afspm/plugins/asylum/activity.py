"""The state of Asylum, and what is awaited of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar, Final

from afspm.basics.clock import Clock
from afspm.basics.errors import Refused
from afspm.model import ControlResponse, Region, ScopeState, ScopeStatus
from afspm.plugins.asylum.result_files import AsylumFiles, Target, free_suffix, local
from afspm.plugins.asylum.session import Session
from afspm.plugins.asylum.xop import MISSING, XopError
from afspm.translator.activity import Activity, TipWay
from afspm.translator.result_files import SCAN, as_list, as_region
from afspm.translator.state import Kept

FORCE: Final = "force"

_SAVED_TO: Final = {SCAN: "SaveImage", FORCE: "SaveForce"}
"""Both a number, of which 2 means that it is saved, and a text, the folder."""
_SAVE: Final = 2.0


class AsylumActivity(Activity):
    """The measurement that runs at the controller, begun by a request or at its panel.

    Args:
        files: takes what comes of it.
        kept: JSON-able, and lasts: the frame of the image that spots are counted on, until when the tip moves, and
            whether a scan has led it away since.
        folders: see `local`.
        frame_in_force: as it was set.
        spot_m: gives the spot that the tip was sent to; None: there are no spots.
        take_curve: begins a force curve.
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

    def status(self) -> ScopeStatus:
        """Return what it is doing now; what has ended is awaited from here on."""
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
        """On the way to where a force curve is to be taken."""
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
        """The frame of the last image that was begun, which Asylum counts spots on."""
        return as_region(self._kept["image"])

    def find_image(self) -> None:
        """Before anything was scanned, and another frame set: that of the image that is open is in force."""
        self._kept.setdefault("image", as_list(self._frame_in_force()))

    def _image_begins(self) -> None:
        """A scan is seen running: not before, as one that does not begin leaves the image of before."""
        if (frame := self._files.frame) is not None:
            self._kept["image"] = frame

    def begin(self, what: str) -> None:
        """Note that a measurement begins; of a force curve at the panel, only its file has the position."""
        taken: dict[str, object] = {"position": None}
        if what == SCAN:
            if "led_away" in self._kept:  # it was sent somewhere
                self._kept["led_away"] = True
            taken = {"frame": as_list(self._frame_in_force())}
        self._files.begin_at(what, self._target(what), taken)

    def begin_curve(self) -> None:
        """Note that a force curve begins where the tip was sent."""
        spot_m = None if self._spot_m is None else list(self._spot_m())
        self._files.begin_at(FORCE, self._target(FORCE), {"position": spot_m})

    def end(self) -> None:
        self._files.end(self._clock.now_ns())

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

    def await_begin(self, what: str) -> None:
        """Wait until what was begun is seen running, or has ended already. Raises Refused."""
        state = ScopeState.SCANNING if what == SCAN else ScopeState.SPEC
        self.settle(what, lambda: self._session.doing().state is state or self._files.has_file())
        self._image_begins()

    def refuse(self, what: str) -> Refused:
        """The refusal of what Asylum said that it does not do; nothing comes of it."""
        self.forget()
        return Refused(
            ControlResponse.ACTION_ERROR, f"Asylum refused to begin the measurement ({what}): see its history window"
        )

    def moves(self, lasts_s: float) -> None:
        """The tip was sent away; it arrives, which Asylum does not tell, after so long at the latest."""
        self.way.sets_out(lasts_s)
        self._kept["led_away"] = False

    @property
    def was_led_away(self) -> bool:
        """True if a scan has taken the tip from where it was sent."""
        return bool(self._kept.get("led_away"))

    def _target(self, what: str) -> Target:
        suffix = self._session.values(["BaseSuffix"])["BaseSuffix"]
        return Target(self.folder(what), self._session.text("GetBaseName"), round(suffix))
