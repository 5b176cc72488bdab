"""Log records on standard error in the supervisor's format: the level, then the message."""

from __future__ import annotations

import logging
import sys

ROOT = "afspm"


class LineFormatter(logging.Formatter):
    """A formatter for "WARNING the tip is blunt"; further lines (a traceback) are indented, without a level."""

    def __init__(self) -> None:
        super().__init__("%(levelname)s %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        return super().format(record).replace("\n", "\n  ")


def set_up(name: str, level: str) -> logging.Logger:
    """Log to standard error from `level` on (libraries: warnings only); return the component's logger."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    logging.getLogger(ROOT).setLevel(level.upper())
    logging.captureWarnings(capture=True)
    return logging.getLogger(f"{ROOT}.{name}")
