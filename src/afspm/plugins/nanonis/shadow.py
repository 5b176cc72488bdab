"""Nanonis, only read: see `translator.shadow`. The list is complete: the shadow sends no other function."""

from __future__ import annotations

from typing import Any, ClassVar, Final

from afspm.driver import ShadowDriver, require_question
from afspm.plugins.nanonis import Nanonis
from afspm.plugins.nanonis.activity import SAFE_TIP, NanonisActivity
from afspm.plugins.nanonis.protocol import NanonisError, UnreadableReply
from afspm.plugins.nanonis.session import APPROACH, Link, Session

QUESTIONS: Final = frozenset({
    *("Util.VersionGet", "Util.SessionPathGet", "Signals.NamesGet", "Bias.Get"),
    *("Scan.StatusGet", "Scan.WaitEndOfScan", "Scan.FrameGet", "Scan.BufferGet", "Scan.SpeedGet", "Scan.PropsGet"),
    *("Scan.FrameDataGrab", "FolMe.XYPosGet", "FolMe.SpeedGet"),
    *("ZCtrl.OnOffGet", "ZCtrl.SetpntGet", "ZCtrl.GainGet", "ZCtrl.StatusGet", "ZCtrl.LimitsGet", "ZCtrl.ZPosGet"),
    *("ZCtrl.CtrlListGet", "Current.Get", "Current.GainsGet", "Piezo.TiltGet", "Piezo.DriftCompGet"),
    *("Piezo.RangeGet", "Piezo.CalibrGet", "Piezo.XYZLimitsGet"),
    *("BiasSpectr.StatusGet", "ZSpectr.StatusGet", "AutoApproach.OnOffGet"),
    *("SafeTip.OnOffGet", "SafeTip.PropsGet"),
})  # fmt: skip
"""Functions of Nanonis that return a value and change nothing; `Scan.WaitEndOfScan` waits at most a second."""
_AUTOSAVE, _OFF = 2, 2
"""The place of the setting in the answer of Scan.PropsGet, and its value while no scan is saved."""


class QuestionLink(Link):
    """A connection to Nanonis that sends the functions of `QUESTIONS` only."""

    def ask(self, name: str, *arguments: object, longer_s: float = 0.0) -> tuple[Any, ...]:
        require_question(name, QUESTIONS)
        return super().ask(name, *arguments, longer_s=longer_s)


class ShadowSession(Session):
    """Both connections, without opening any module: opening one shows its window on the person's screen."""

    link: ClassVar[type[Link]] = QuestionLink

    def _open(self, module: str) -> bool:
        try:
            self.ask(f"{module}.OnOffGet" if module == APPROACH else f"{module}.StatusGet")
        except (NanonisError, UnreadableReply) as error:
            self._log.warning("the module %s is not open in Nanonis: its work is not seen (%s)", module, error)
            return False
        return True


class ShadowActivity(NanonisActivity):
    """The state of Nanonis, whose measurements only a person starts and stops."""

    def stop_scan(self) -> None:
        # called by the poll that finds the safe tip's withdrawal: a run would stop the scan, which is in the air
        self._log.error("%s; a run would have stopped the scan", SAFE_TIP)
        self.stopped()


class NanonisShadow(ShadowDriver, Nanonis):
    """A Nanonis controller beside a person, read by `QUESTIONS` alone."""

    session_class: ClassVar[type[Session]] = ShadowSession
    activity_class: ClassVar[type[NanonisActivity]] = ShadowActivity

    def connect(self) -> None:
        super().connect()
        if self._ask("Scan.PropsGet")[_AUTOSAVE] == _OFF:
            self.log.warning("Nanonis saves no scans (Scan Control > Save): the shadow fetches complete ones over TCP")
