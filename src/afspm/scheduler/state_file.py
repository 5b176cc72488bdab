"""What the scheduler must not forget when it is killed: a small JSON file that is replaced as a whole."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from afspm.errors import FileError


class StateFile:
    """Holds mode, holder, problems …; what it holds was written before anybody was told.

    Args:
        path: of the file; None: nothing is kept.
    """

    def __init__(self, path: Path | None, log: logging.Logger) -> None:
        self.path = path
        self._log = log

    def load(self) -> dict[str, Any]:
        """What was saved last; empty if nothing was.

        Raises:
            FileError: there is a file that can't be read. To begin without it could give control to two.
        """
        if self.path is None or not self.path.exists():
            return {}
        try:
            state = json.loads(self.path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise FileError(
                f"what was in force before the restart can't be read: {error}",
                where=str(self.path),
                hint="delete the file to begin with nobody in control",
            ) from error
        if not isinstance(state, dict):
            raise FileError("this is not the state of a scheduler", where=str(self.path), hint="delete the file")
        return state

    def save(self, state: dict[str, Any]) -> None:
        """Write it aside and rename: whoever reads finds the old state or the new one.

        A disk that is full must not end the experiment: it is said, and the experiment goes on.
        """
        if self.path is None:
            return
        aside = self.path.with_suffix(".new")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            aside.write_text(json.dumps(state, ensure_ascii=False), encoding="utf-8")
            aside.replace(self.path)
        except OSError as error:
            self._log.critical("a restart would not know what is in force now: %s: %s", self.path, error)
