"""Log records to standard error, as the supervisor reads them: the level, then the message."""

from __future__ import annotations

import logging
import sys

ROOT = "afspm"


class LineFormatter(logging.Formatter):
    """ "WARNING the tip is blunt". Further lines (a traceback) have no level and are indented."""

    def __init__(self) -> None:
        super().__init__("%(levelname)s %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        return super().format(record).replace("\n", "\n  ")


def set_up(name: str, level: str) -> logging.Logger:
    """Send records of `level` and above to standard error, of libraries only warnings; returns the logger of the
    component `name`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    logging.getLogger(ROOT).setLevel(level.upper())
    logging.captureWarnings(capture=True)
    return logging.getLogger(f"{ROOT}.{name}")
