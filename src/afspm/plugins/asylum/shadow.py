"""Asylum, only read: see `translator.shadow`. The list is complete: the shadow calls no other function."""

from __future__ import annotations

from typing import ClassVar, Final

from afspm.basics import Refused
from afspm.driver import POSITION, ShadowDriver, require_question
from afspm.plugins.asylum import Asylum, xop
from afspm.plugins.asylum.link import Link

QUESTIONS: Final = frozenset({
    *("GV", "GS", "ARGetStatus", "GetBaseName", "AfspmLook", "AfspmController", "AfspmFeedbackOn"),
})  # fmt: skip
"""Functions in Igor that return a value and change nothing."""
_SAVES: Final = "SaveImage"


class QuestionLink(Link):
    """A connection to Igor that calls the functions of `QUESTIONS` only."""

    def call(self, name: str, *parameters: xop.Parameter) -> xop.Reply:
        require_question(name, QUESTIONS)
        return super().call(name, *parameters)


class AsylumShadow(ShadowDriver, Asylum):
    """An Asylum microscope beside a person, read by `QUESTIONS` alone.

    The position of the tip is not read: Asylum reports it only after a call that initialises it.
    """

    link: ClassVar[type[Link]] = QuestionLink

    def connect(self) -> None:
        self._spots, self._base_name = "none", ""
        self._whole_table = self._whole_table.without(POSITION)
        super().connect()
        try:
            saves = self.session().values([_SAVES])[_SAVES]
        except Refused:
            return
        if not saves:
            self.log.warning("Asylum saves no images (Save Images on its panel): the shadow sees none of them")
