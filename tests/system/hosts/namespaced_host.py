"""A host of its own on this computer: network, process ids, names, boot, and a clock on the wall."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.system.hosts.faulty_network import FaultyNetwork
from tests.system.hosts.host_init import DEVICE

_INIT = Path(__file__).with_name("host_init.py")
_NAMESPACES = ("--net", "--mount", "--uts", "--ipc", "--pid", "--fork", "--mount-proc")
_CLOCK = Path(__file__).with_name("shifted_clock.c")


class Host:
    """A host on a network, with a folder that stands for its disk: it stays when the host loses its power.

    Args:
        known: the names of hosts, with their addresses, as this host resolves them.
        clock_ahead_s: by how much its clock on the wall is ahead.
    """

    def __init__(
        self,
        network: FaultyNetwork,
        name: str,
        folder: Path,
        known: Mapping[str, str],
        *,
        clock_ahead_s: float = 0.0,
    ) -> None:
        self.name, self.folder, self.clock_ahead_s = name, folder, clock_ahead_s
        self._network = network
        self._hosts_file, self._boot_id_file = folder / "hosts", folder / "boot_id"
        folder.mkdir(parents=True, exist_ok=True)
        self.resolve(known)
        self.start()

    def start(self) -> None:
        """Switch it on."""
        address = self.known[self.name]
        self._boot_id_file.write_text(f"{uuid.uuid4()}\n", encoding="ascii")
        self._plug, its = socket.socketpair()
        with its:
            command = ["unshare", *_NAMESPACES, sys.executable, str(_INIT), self.name, address]
            command += [str(self._hosts_file), str(self._boot_id_file), str(its.fileno())]
            self._unshare = subprocess.Popen(command, pass_fds=[its.fileno()], start_new_session=True)
            its.close()
            said, devices, *_ = socket.recv_fds(self._plug, 16, 1)
        assert said == b"ready", f"host {self.name} did not start"
        self._init = _child_of(self._unshare.pid)
        self._network.plug(self.name, devices[0], address)

    def lose_power(self) -> None:
        """End all its processes at once, with the link down, so that nobody hears of it."""
        self._network.unplug(self.name)
        self._plug.close()
        self._unshare.wait()

    def resolve(self, known: Mapping[str, str]) -> None:
        """Let it know the addresses of names, from now on."""
        self.known = dict(known)
        lines = ["127.0.0.1 localhost", *(f"{address} {name}" for name, address in known.items())]
        self._hosts_file.write_text("\n".join([*lines, ""]), encoding="ascii")  # in place: it is mounted

    def move(self, address: str) -> None:
        """Give it another address."""
        for change in (f"del {self.known[self.name]}/24", f"add {address}/24"):  # as others are secondary to the first
            self.check_output("ip", "address", *change.split(), "dev", DEVICE)
        self._network.readdress(self.name, address)

    def peak_mb(self) -> float:
        """Return the largest memory that any of its processes has had so far, MB."""
        peaks = self.check_output("sh", "-c", "cat /proc/[0-9]*/status | grep VmHWM").split()
        return max(int(kb) for kb in peaks[1::3]) / 1000

    def command(self, *command: str) -> list[str]:
        """Return a command of this computer that runs another on this host, in its folder."""
        # nsenter's own --pid has only its child in there, which is what we want
        return ["nsenter", "--all", f"--target={self._init}", f"--wd={self.folder}", *command]

    def environment(self, **more: str) -> dict[str, str]:
        """Return the environment of its programs."""
        found = {**os.environ, **more}
        if self.clock_ahead_s:
            found |= {"LD_PRELOAD": str(_shifted_clock(self.folder)), "CLOCK_AHEAD_S": f"{self.clock_ahead_s:.0f}"}
        return found

    def popen(self, command: Sequence[str]) -> subprocess.Popen[bytes]:
        """Start a program on it."""
        return subprocess.Popen(
            self.command(*command), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env=self.environment(), start_new_session=True,
        )  # fmt: skip

    def check_output(self, *command: str) -> str:
        """Run a program on it to its end, and return what it printed."""
        return self.run(*command, check=True).stdout

    def run(self, *command: str, check: bool = False) -> subprocess.CompletedProcess[str]:
        """Run a program on it to its end."""
        return subprocess.run(
            self.command(*command),
            check=check,
            capture_output=True,
            encoding="utf-8",
            env=self.environment(),
            timeout=90,
        )


def _shifted_clock(folder: Path) -> Path:
    """Return the library that shifts the clock on the wall: a namespace of time shifts every other clock."""
    library = folder / "shifted_clock.so"
    if not library.exists():
        subprocess.run(["cc", "-shared", "-fPIC", "-O2", "-o", str(library), str(_CLOCK)], check=True)
    return library


def interrupt(process: subprocess.Popen[bytes]) -> None:
    """Press Ctrl-C for a program that runs on a host: `process` is what entered the host's namespaces for it."""
    with contextlib.suppress(ProcessLookupError, IndexError):
        os.kill(_child_of(process.pid), signal.SIGINT)


def _child_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()[0])
