"""SmartScan, only read: see `translator.shadow`. The list is complete: the shadow sends nothing else."""

from __future__ import annotations

import re
from typing import Any, ClassVar, Final

from afspm.driver import ShadowDriver, refusal, require_question
from afspm.plugins.park import Park
from afspm.plugins.park.link import GEOMETRY, IS_CONNECTED, SCAN_STATUS, SCRIPT_RUNS, Link, shown

QUESTIONS: Final = frozenset({IS_CONNECTED, SCAN_STATUS, SCRIPT_RUNS, GEOMETRY})
"""Methods of SmartRemote that return a value and change nothing."""
_PATH: Final = r"spm(?:\.[A-Za-z_]\w*)+"
SCRIPTS: Final = re.compile(rf"\[{_PATH}(?:, {_PATH})*\]|typeof {_PATH}", re.ASCII)
"""Expressions that name values: neither a call nor an assignment fits."""


class QuestionLink(Link):
    """A connection to SmartScan that sends `QUESTIONS` and `SCRIPTS` only."""

    def ask(self, method: str) -> Any:
        require_question(method, QUESTIONS)
        return super().ask(method)

    def run(self, expression: str) -> Any:
        if not SCRIPTS.fullmatch(expression):
            raise refusal(shown(expression))
        return super().run(expression)

    def begin(self, expression: str) -> None:
        raise refusal(shown(expression))


class ParkShadow(ShadowDriver, Park):
    """A microscope behind SmartScan beside a person, read by `QUESTIONS` and `SCRIPTS` alone."""

    link: ClassVar[type[Link]] = QuestionLink
