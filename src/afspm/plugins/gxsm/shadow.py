"""GXSM, only read: see `translator.shadow`. The list is complete: the shadow calls no other function."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from afspm.driver import ShadowDriver, require_question
from afspm.plugins.gxsm import Gxsm
from afspm.plugins.gxsm.link import Link

QUESTIONS: Final = frozenset({
    *("get", "gets", "list_refnames", "list_actions", "rtquery", "y_current", "chfname"),
    *("get_dimensions", "get_differentials", "get_slice"),
})  # fmt: skip
"""Functions of GXSM that return a value and change nothing."""


class QuestionLink:
    """A link to GXSM that calls the functions of `QUESTIONS` only."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self.close = link.close

    def call(self, method: str, *arguments: str | int | float) -> Any:
        require_question(method, QUESTIONS)
        return self._link.call(method, *arguments)

    def working_folder(self) -> Path | None:
        return self._link.working_folder()


class GxsmShadow(ShadowDriver, Gxsm):
    """A microscope that GXSM controls beside a person, read by `QUESTIONS` alone."""

    def _open_link(self) -> Link:
        return QuestionLink(super()._open_link())

    def connect(self) -> None:
        # a run switches Auto Save, and saves its own scans: here only GXSM saves
        self._saving = replace(self._saving, by_us=False)
        super().connect()
