"""Lines of a process on standard error."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import logging
from afspm.transport.process import log
own = log.set_up("series", "DEBUG")
own.debug("ours")
logging.getLogger("matplotlib.font_manager").debug("findfont: score(...) = 10.05")
logging.getLogger("matplotlib").warning("no such font")
"""


def test_debug_records_of_libraries_are_dropped() -> None:
    ran = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, encoding="utf-8", check=True)
    assert ran.stderr.splitlines() == ["DEBUG ours", "WARNING no such font"]


def test_log_line_does_not_command_the_terminal() -> None:
    script = SCRIPT + 'own.warning("\\x1b[2J\\x9b2J of a file,\\r\\nand µm\\tin a table")\n'
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, encoding="utf-8", check=True)
    assert ran.stderr.splitlines()[2:] == ["WARNING \\x1b[2J\\x9b2J of a file,\\r", "  and µm\tin a table"]
