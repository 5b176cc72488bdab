"""The Python interpreter for processes that afspm starts."""

from __future__ import annotations

import sys
from collections.abc import Mapping


def python_command(module: str) -> tuple[str, ...]:
    """Return the command that runs a module as a process.

    With -P only installed modules are found, never a file of the same name in the current folder.
    """
    return (_executable(), "-P", "-m", module)


def python_environment() -> Mapping[str, str]:
    """Return the environment variables to add for `python_command`.

    In a virtual environment of Windows `sys.executable` is only a launcher with another process number, which starts
    the real Python. afspm starts the real Python directly; the variable `__PYVENV_LAUNCHER__` names the virtual
    environment.
    """
    return {} if _executable() == sys.executable else {"__PYVENV_LAUNCHER__": sys.executable}


def _executable() -> str:
    base = getattr(sys, "_base_executable", sys.executable)
    return base if sys.platform == "win32" and base else sys.executable
