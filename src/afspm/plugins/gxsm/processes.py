"""The GXSM process that receives SIGUSR1. This signal would end most other processes. Linux only."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil

from afspm.driver import ControllerLost

_SIGUSR1_BIT: Final = 1 << 9  # signal 10, counted from 1


class NoProcess(ControllerLost):
    """The error that no process has this name or number."""


@dataclass(frozen=True)
class GxsmProcess:
    """A process, identified by number and start time (in ticks), since numbers are reused."""

    pid: int
    started: str | None

    def lives(self) -> bool:
        """Return True if the process still runs. Each poll calls this method; psutil would be ten times slower."""
        return self.started is not None and _started(self.pid) == self.started

    def working_folder(self) -> Path | None:
        """Return the current folder of the process; None: not accessible."""
        try:
            return Path(psutil.Process(self.pid).cwd())
        except psutil.Error:
            return None

    def signal(self, number: int) -> None:
        """Send a signal.

        Raises:
            ControllerLost: the process has ended, or belongs to another user.
        """
        if not self.lives():
            raise ControllerLost(f"GXSM, process {self.pid}, has ended")
        try:
            os.kill(self.pid, number)
        except OSError as error:
            raise ControllerLost(f"GXSM, process {self.pid}, can't be signalled: {error}") from error


def find(process: str) -> GxsmProcess:
    """Return the process with this name or number, which must handle or wait for SIGUSR1.

    Raises:
        NoProcess: there is no such process.
        ControllerLost: several processes have the name, or the process would be ended by SIGUSR1.
    """
    named = (one.pid for one in psutil.process_iter(["name"]) if process in (str(one.pid), one.info["name"]))
    found = [one for one in (GxsmProcess(pid, _started(pid)) for pid in named) if one.lives()]
    if not found:
        raise NoProcess(f"no process is called {process!r}", hint="is Gxsm4 running?")
    if len(found) > 1:
        hint = 'choose one by its process number: address = "shm:@<number>"'
        raise ControllerLost(f"{len(found)} processes are called {process!r}", hint=hint)
    if not _expects_signals(found[0].pid):
        raise ControllerLost(
            f"process {found[0].pid} does not serve its shared memory", hint="was GXSM started with -s?"
        )
    return found[0]


def _started(pid: int) -> str | None:
    try:
        fields = Path("/proc", str(pid), "stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return fields[19] if len(fields) > 19 and fields[0] not in ("Z", "X") else None


def _expects_signals(pid: int) -> bool:
    # SIGUSR1 ends a process that neither handles it nor waits for it.
    try:
        status = Path("/proc", str(pid), "status").read_text(errors="replace")
    except OSError:
        return False
    lines = (line.partition(":") for line in status.splitlines())
    masks = {key: value.strip() for key, _, value in lines if key in ("SigBlk", "SigCgt")}
    return any(int(mask, 16) & _SIGUSR1_BIT for mask in masks.values())
