"""The process that is to be signalled, as Linux tells of it: a signal to the wrong one would end it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from afspm.translator.driver import ControllerLost

_PROC: Final = Path("/proc")
_SIGUSR1_BIT: Final = 1 << 9  # signal 10, counted from 1
_DEAD: Final = ("Z", "X")


class NoProcess(ControllerLost):
    """No process of that name, or number, is there."""


@dataclass(frozen=True)
class Process:
    """A process, told from a later one with the same number by when it was started."""

    pid: int
    started: str

    def lives(self) -> bool:
        """Whether it is still there."""
        return _started(self.pid) == self.started

    def working_folder(self) -> Path | None:
        """Return the folder in which it runs; None: it may not be known."""
        try:
            return (_PROC / str(self.pid) / "cwd").readlink()
        except OSError:
            return None

    def signal(self, number: int) -> None:
        """Send it a signal.

        Raises:
            ControllerLost: it is gone, or belongs to somebody else.
        """
        if not self.lives():
            raise ControllerLost(f"GXSM, process {self.pid}, has ended")
        try:
            os.kill(self.pid, number)
        except OSError as error:
            raise ControllerLost(f"GXSM, process {self.pid}, can't be signalled: {error}") from error


def find(process: str) -> Process:
    """The process of a name, or of a number, which expects to be signalled.

    Raises:
        NoProcess: there is none. ControllerLost: there are several, or it does not expect signals.
    """
    if process.isdigit():
        pids = [int(process)] if _started(int(process)) else []
    else:
        pids = [pid for pid in _all() if _name(pid) == process]
    if not pids:
        raise NoProcess(f"no process is called {process!r}", hint="is Gxsm4 running?")
    if len(pids) > 1:
        hint = 'one can be chosen by its number: address = "shm:@<number>"'
        raise ControllerLost(f"{len(pids)} processes are called {process!r}", hint=hint)
    started = _started(pids[0])
    if started is None or not _expects_signals(pids[0]):
        raise ControllerLost(f"process {pids[0]} does not serve its shared memory", hint="was GXSM started with -s?")
    return Process(pids[0], started)


def _all() -> list[int]:
    return [int(entry.name) for entry in _PROC.iterdir() if entry.name.isdigit() and _started(int(entry.name))]


def _read(pid: int, file: str) -> str:
    try:
        return (_PROC / str(pid) / file).read_text(errors="replace")
    except OSError:
        return ""


def _name(pid: int) -> str:
    return _read(pid, "comm").rstrip("\n")


def _started(pid: int) -> str | None:
    """When, in ticks since the computer was; None if it is gone."""
    fields = _read(pid, "stat").rpartition(")")[2].split()
    return fields[19] if len(fields) > 19 and fields[0] not in _DEAD else None


def _expects_signals(pid: int) -> bool:
    """Whether it handles the signal, or waits for it: one that does neither is ended by it."""
    lines = (line.partition(":") for line in _read(pid, "status").splitlines())
    masks = {key: value.strip() for key, _, value in lines if key in ("SigBlk", "SigCgt")}
    return any(int(mask, 16) & _SIGUSR1_BIT for mask in masks.values())
