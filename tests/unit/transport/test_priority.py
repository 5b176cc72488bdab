"""Processes that only observe have a lower priority."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

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


@pytest.mark.skipif(sys.platform != "win32", reason="only there are classes of priority")
def test_on_windows_the_whole_process_steps_back() -> None:
    assert subprocess.run((sys.executable, "-c", CLASS_TOLD), capture_output=True, check=True).stdout.split() == [
        b"True"
    ]


@pytest.mark.skipif(sys.platform == "win32", reason="there are classes of priority there")
def test_later_threads_step_back_and_on_linux_the_heartbeat_does_not() -> None:
    ours = os.nice(0)
    early, late = map(int, subprocess.run((sys.executable, "-c", TOLD), capture_output=True, check=True).stdout.split())
    assert late == min(19, ours + 10)
    if sys.platform == "linux":
        assert early == ours
