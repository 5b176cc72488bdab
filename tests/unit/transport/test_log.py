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
