"""The commands of `afspm`. Each module reads arguments, calls another package, and prints; it makes no decisions."""

from __future__ import annotations

import io
import sys
from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.cli.arguments import AFTERWARDS, MEANWHILE, RUNS, NoProgress, Where, names_in, opt
    from afspm.cli.joining import looking, plain_console, plain_table

if TYPE_CHECKING:  # one command has it, and another may
    from afspm.cli.arguments import HelpWhenBare, RecordedRun
    from afspm.cli.declared_commands import DeclaredCommands

__all__ = [
    "AFTERWARDS",
    "MEANWHILE",
    "RUNS",
    "DeclaredCommands",
    "HelpWhenBare",
    "NoProgress",
    "RecordedRun",
    "Where",
    "looking",
    "names_in",
    "opt",
    "plain_console",
    "plain_table",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.cli.arguments": "AFTERWARDS MEANWHILE RUNS NoProgress Where names_in opt HelpWhenBare RecordedRun",
            "afspm.cli.declared_commands": "DeclaredCommands",
            "afspm.cli.joining": "looking plain_console plain_table",
        },
    )


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
