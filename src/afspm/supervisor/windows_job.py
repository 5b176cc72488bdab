"""Job objects of Windows: end a child with all that it has started, and with us. Elsewhere `reaper` does that."""

from __future__ import annotations

import contextlib
import ctypes
import subprocess
import sys
from typing import Any

_EXTENDED_LIMITS = 9  # JobObjectExtendedLimitInformation
_KILL_ON_CLOSE = 0x2000  # JOB_OBJECT_LIMIT_KILL_ON_JOB_CLOSE
_KILLED = 1


class _Limits(ctypes.Structure):
    """JOBOBJECT_EXTENDED_LIMIT_INFORMATION; of it only the flags are set."""

    _fields_ = (
        ("per_process_user_time", ctypes.c_int64),
        ("per_job_user_time", ctypes.c_int64),
        ("flags", ctypes.c_uint32),
        ("minimum_working_set", ctypes.c_size_t),
        ("maximum_working_set", ctypes.c_size_t),
        ("active_processes", ctypes.c_uint32),
        ("affinity", ctypes.c_size_t),
        ("priority", ctypes.c_uint32),
        ("scheduling", ctypes.c_uint32),
        ("counters", ctypes.c_uint64 * 6),
        ("memory", ctypes.c_size_t * 4),
    )


class WindowsJob:
    """A child and all that it starts, ended together.

    Args:
        has_tip: it is not ended with us, since it sees to the tip first; it ends by itself.
    """

    def __init__(self, child: subprocess.Popen[bytes], *, has_tip: bool) -> None:
        self._handle = 0
        self._kernel: Any = None
        if sys.platform != "win32":
            return
        kernel = ctypes.WinDLL("kernel32", use_last_error=True)
        kernel.CreateJobObjectW.restype = ctypes.c_void_p
        self._kernel = kernel
        self._handle = kernel.CreateJobObjectW(None, None) or 0
        limits = _Limits(flags=0 if has_tip else _KILL_ON_CLOSE)
        job = ctypes.c_void_p(self._handle)
        kernel.SetInformationJobObject(job, _EXTENDED_LIMITS, ctypes.byref(limits), ctypes.sizeof(limits))
        kernel.AssignProcessToJobObject(job, ctypes.c_void_p(int(child._handle)))

    def kill(self) -> None:
        """End all that is in it."""
        if self._handle:
            self._kernel.TerminateJobObject(ctypes.c_void_p(self._handle), _KILLED)

    def close(self) -> None:
        """Let go of it; what is left in it ends, unless it has a tip to see to."""
        if self._handle:
            handle, self._handle = self._handle, 0
            with contextlib.suppress(OSError):
                self._kernel.CloseHandle(ctypes.c_void_p(handle))
