"""Log records to standard error, as the supervisor reads them: the level, then the message."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable

ROOT = "afspm"


class LineFormatter(logging.Formatter):
    """ "WARNING the tip is blunt". Further lines (a traceback) have no level and are indented."""

    def __init__(self) -> None:
        super().__init__("%(levelname)s %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        return super().format(record).replace("\n", "\n  ")


class PublishingHandler(logging.Handler):
    """Gives records, as (level, text), to `publish`: for a log collector on another computer, say."""

    def __init__(self, publish: Callable[[int, str], None]) -> None:
        super().__init__()
        self._publish = publish

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._publish(record.levelno, self.format(record))
        except Exception:
            self.handleError(record)


def set_up(name: str, level: str) -> logging.Logger:
    """Send all records of `level` and above to standard error; returns the logger of the component `name`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    logging.captureWarnings(capture=True)
    return logging.getLogger(f"{ROOT}.{name}")
