"""Log records on standard error in the supervisor's format: the level, then the message."""

from __future__ import annotations

import logging
import re
import sys

ROOT = "afspm"
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


class LineFormatter(logging.Formatter):
    """A formatter for "WARNING the tip is blunt"; further lines (a traceback) are indented, without a level."""

    def __init__(self) -> None:
        super().__init__("%(levelname)s %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        # a text from outside must not command the terminal that shows the log
        text = _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), super().format(record))
        return text.replace("\n", "\n  ")


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
