"""The state that survives a kill: a small file of JSON lines; the last line is valid."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from afspm.basics.errors import InvalidValue
from afspm.model.snapshot import restored, snapshot
from afspm.scheduler.saved_state import KIND, VERSION, SavedState
from afspm.storage.atomic import CheckpointFile, OutageLog, load_checkpoint


class StateFile:
    """The file of mode, holder, problems …, saved each time before they are published.

    Args:
        path: of the file; None: nothing is stored.
    """

    def __init__(self, path: Path | None, log: logging.Logger) -> None:
        self.path = path
        self._generations = None if path is None else CheckpointFile(path)
        self._log = log
        self._outage = OutageLog("a restart would not know the present state", log)

    def load(self) -> SavedState | None:
        """Return the state saved last; None if none was.

        If a power cut has damaged it, the generation before is used, with its mode and problems, but without a holder:
        the holder may have changed since, and requests control again.

        Raises:
            FileError: neither can be read. Starting without a flagged problem could cost a tip.
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
        """Write the state, so that it outlives a kill.

        A full disk must not end the experiment: the outage is logged, and the experiment goes on.
        """
        if self._generations is None:
            return
        with self._outage.trying():
            self._generations.save(json.dumps(snapshot(state, KIND, VERSION), ensure_ascii=False).encode())

    def close(self) -> None:
        """Flush the last state to the disk."""
        if self._generations is not None:
            self._generations.close()


def _read(content: bytes) -> SavedState:
    try:
        return restored(SavedState, json.loads(content), KIND, VERSION)
    except (InvalidValue, AttributeError) as error:
        raise ValueError(str(error)) from error
