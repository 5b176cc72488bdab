"""The state that survives a kill: a small file of JSON lines, of which the last holds."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from afspm.basics.errors import InvalidValue
from afspm.model.snapshot import restored, snapshot
from afspm.scheduler.saved_state import KIND, VERSION, SavedState
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
        self._outage = OutageLog("a restart would not know what is in force now", log)

    def load(self) -> SavedState | None:
        """Return what was saved last; None if nothing was.

        If that is damaged, as a power cut may leave it, the generation before is taken up: the mode, and the problems
        that stand, but nobody in control. Who was then may not be now, and asks again.

        Raises:
            FileError: neither can be read. To begin without a problem that is flagged could cost a tip.
        """
        if self.path is None:
            return None
        state, damage = load_checkpoint(self.path, _read)
        if state is None or not damage:
            return state
        self._log.critical(
            "the newest saved state is damaged, the one before it is used, with no component in control: %s", damage
        )
        return state.without_holder()

    def save(self, state: SavedState) -> None:
        """Write it down; when this returns it outlives a kill.

        A disk that is full must not end the experiment: it is said, and the experiment goes on.
        """
        if self._generations is None:
            return
        with self._outage.trying():
            self._generations.save(json.dumps(snapshot(state, KIND, VERSION), ensure_ascii=False).encode())

    def close(self) -> None:
        """Make sure that what was saved last is on the disk."""
        if self._generations is not None:
            self._generations.close()


def _read(content: bytes) -> SavedState:
    try:
        return restored(SavedState, json.loads(content), KIND, VERSION)
    except (InvalidValue, AttributeError) as error:
        raise ValueError(str(error)) from error
