"""How a blocking call is ended from outside."""

from __future__ import annotations


class StopRequested(BaseException):
    """The parent has gone or wants us to stop.

    Not an `Exception`, like KeyboardInterrupt: a script's `except Exception` must not keep a process alive.
    """
