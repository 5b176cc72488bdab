"""The commands of `afspm`. Each module reads arguments, calls another package, and prints; it makes no decisions."""

from __future__ import annotations

import io
import sys


def main() -> None:
    """Run the command line. An `AfspmError` is printed as its message; any other error shows its traceback."""
    from afspm.basics.errors import AfspmError

    for stream in (sys.stdout, sys.stderr):  # a character that the terminal lacks must not lose the line
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
            if sys.platform == "win32" and not stream.isatty():  # otherwise output is in the computer's code page
                stream.reconfigure(encoding="utf-8")
    try:
        from afspm.cli.app import app  # in here: a Ctrl-C during this import needs no traceback

        app()
    except AfspmError as error:
        print(f"afspm: {error}", file=sys.stderr)  # noqa: T201
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
