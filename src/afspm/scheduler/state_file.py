"""What the scheduler must not forget when it is killed: a small file of JSON lines, of which the last holds."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from afspm.storage.atomic import CheckpointFile, OutageLog, load_checkpoint


class StateFile:
    """Holds mode, holder, problems …; what it holds was written before anybody was told.

    Args:
        path: of the file; None: nothing is kept.
    """

    def __init__(self, path: Path | None, log: logging.Logger) -> None:
        self.path = path
        self._generations = None if path is None else CheckpointFile(path)
        self._log = log
        self._told = OutageLog("a restart would not know what is in force now", log)

    def load(self) -> dict[str, Any]:
        """What was saved last; empty if nothing was.

        If that is damaged, as a power cut may leave it, the generation before is taken up: the mode, and the problems
        that stand, but nobody in control. Who was then may not be now, and asks again.

        Raises:
            FileError: neither can be read. To begin without a problem that is flagged could cost a tip.
        """
        if self.path is None:
            return {}
        state, damage = load_checkpoint(self.path, _read)
        if state is None:
            return {}
        if damage:
            self._log.critical(
                "what was in force is damaged, the generation before is taken up, with nobody in control: %s", damage
            )
            control = {**state["control"], "holder": None, "solving": 0}
            state = {**state, "control": control, "granted_to": None}
        return state

    def save(self, state: dict[str, Any]) -> None:
        """Write it down; when this returns it outlives a kill.

        A disk that is full must not end the experiment: it is said, and the experiment goes on.
        """
        if self._generations is None:
            return
        with self._told.trying():
            self._generations.save(json.dumps(state, ensure_ascii=False).encode())

    def close(self) -> None:
        """Make sure that what was saved last is on the disk."""
        if self._generations is not None:
            self._generations.close()


def _read(content: bytes) -> dict[str, Any]:
    state = json.loads(content)
    if not isinstance(state, dict) or not isinstance(state.get("control"), dict):
        raise ValueError("it is not the state of a scheduler")
    return state
