"""Studio, only read: see `translator.shadow`. The list is complete: the shadow runs no other script."""

from __future__ import annotations

import re
from typing import Any, ClassVar, Final

from afspm.basics import ConfigError
from afspm.driver import ShadowDriver, refusal
from afspm.plugins.nanosurf import SAVES, Nanosurf, commands
from afspm.plugins.nanosurf.link import Link, shown
from afspm.plugins.nanosurf.session import VERSIONS, Session

_TEXT: Final = r'"(?:[^"\\\n]|\\.)*"'
_LIST: Final = rf"(?:{_TEXT}(?:, {_TEXT})*)?"
_VALUE: Final = r"root\.workflow(?:\.[a-z]\w*)+\.(?:value|value_raw|unit)_get\(\)"
SCRIPTS: Final = re.compile(
    "|".join((
        re.escape("return root.session.select_main(0)"),
        re.escape(VERSIONS),
        rf"return root\.session\.select\({_TEXT}, \d\)",
        re.escape(f"return {commands.WORKFLOW}.{commands.IS_SCANNING}(), 0"),
        rf"return {_VALUE}(?:, {_VALUE})*",
        *(_LIST.join(map(re.escape, script.split("%s"))) for script in (commands.MISSING, commands.UNITS)),
    )),
    re.ASCII,
)  # fmt: skip
"""Scripts that return values and change nothing; a session is selected for the shadow's own connection."""


class QuestionLink(Link):
    """A connection to Studio that runs `SCRIPTS` only."""

    def begin(self, script: str) -> None:
        if not SCRIPTS.fullmatch(script):
            raise refusal(shown(script))
        super().begin(script)


class NanosurfShadow(ShadowDriver, Nanosurf):
    """A microscope behind Nanosurf Studio 17 or 18 beside a person, read by `SCRIPTS` alone.

    Other releases report scans, or approaches, only to handlers that a script leaves in Studio.
    """

    link: ClassVar[type[Link]] = QuestionLink
    lines = ShadowDriver.lines  # none: `SCRIPTS` has no script for the buffer of a running scan

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        if not self.asks_once and (
            commands.is_before_this_tree(self._release) or not commands.has_old_commands(self._release)
        ):
            problem = f"a shadow can't see what Nanosurf Studio {self._release} does without leaving handlers in it"
            raise ConfigError(problem, where="release", hint="shadows are for releases 17 and 18")

    def _save_files(self, session: Session) -> None:
        if session.values(list(SAVES)) != SAVES:
            self.log.warning("Studio does not save each measurement to a new .nhf file: the shadow sees only new files")
