"""Processes that only observe have a lower priority."""

from __future__ import annotations

import os
import subprocess
import sys

TOLD = """
import os, threading
from afspm.transport.process.context import step_back

before, told = threading.Event(), []
early = threading.Thread(target=lambda: (before.wait(), told.append(os.nice(0))))
early.start()
step_back()
before.set()
early.join()
late = threading.Thread(target=lambda: told.append(os.nice(0)))
late.start()
late.join()
print(*told)
"""


CLASS_TOLD = """
import psutil
from afspm.transport.process.context import step_back
step_back()
print(psutil.Process().nice() == psutil.BELOW_NORMAL_PRIORITY_CLASS)
"""


def printed_by(code: str) -> list[str]:
    return subprocess.run((sys.executable, "-c", code), capture_output=True, check=True, text=True).stdout.split()


def test_an_observer_steps_back_and_on_linux_its_heartbeat_does_not() -> None:
    if sys.platform == "win32":  # there the whole process has a class of priority
        assert printed_by(CLASS_TOLD) == ["True"]
        return
    ours = os.nice(0)
    early, late = map(int, printed_by(TOLD))
    assert late == min(19, ours + 10)
    if sys.platform == "linux":
        assert early == ours
