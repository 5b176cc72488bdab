"""Clients of GXSM without afspm's code: by a plain socket, and by plain shared memory."""

from __future__ import annotations

import base64
import hmac
import json
import mmap
import os
import pickle
import secrets
import select
import signal
import socket
import struct
from pathlib import Path
from typing import Any

import numpy as np
from deadlines import DEADLINE_S


class SocketClient:
    """A client of the bridge as the README describes it: two proofs, then lines of JSON."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        self._socket = socket.create_connection((host, int(port)), DEADLINE_S)
        self._lines = self._socket.makefile("rb")
        secret = Path("~/.afspm/gxsm-bridge-secret").expanduser().read_bytes().strip()
        mine = secrets.token_hex(32)
        theirs, proof = self.call("challenge", mine)

        def proves(side: str) -> str:
            text = "\n".join(("afspm bridge 2", side, address, mine, theirs))
            return hmac.new(secret, text.encode(), "sha256").hexdigest()

        assert proof == proves("bridge")
        assert self.call("response", proves("client")) == "afspm bridge 2"

    def call(self, method: str, *arguments: Any) -> Any:
        self.send(json.dumps([method, *arguments]).encode() + b"\n")
        return self.reply()

    def reply(self) -> Any:
        reply = json.loads(self._lines.readline())
        if "error" in reply:
            raise RuntimeError(reply["error"])
        value = reply["value"]
        if isinstance(value, dict):
            content = base64.b64decode(value["bytes"])
            return np.frombuffer(content, value["array"]).reshape(value["shape"])
        return value

    def send(self, lines: bytes) -> None:
        self._socket.sendall(lines)

    def sent_away(self, lines: bytes) -> bool:
        """Send lines; return True if the bridge disconnects without an answer."""
        self.send(lines)
        try:
            return not self._lines.readline()
        except ConnectionError:
            return True

    def close(self) -> None:
        self._lines.close()
        self._socket.close()


class MemoryClient:
    """A client of Gxsm4's shared memory.

    Args:
        locked: True takes the lock of all callers.
    """

    def __init__(self, address: str, *, locked: bool = True) -> None:
        block, _, pid = address.removeprefix("shm:").partition("@")
        self._pid = int(pid)
        self._locked = locked
        with Path("/dev/shm", block).open("r+b") as file:
            self.memory = mmap.mmap(file.fileno(), 16_777_344)

    def call(self, method: str, *arguments: Any) -> Any:
        import fcntl

        with Path("/tmp/gxsm4_pyshm_transaction.lock").open("a") as lock:
            if self._locked:
                fcntl.flock(lock, fcntl.LOCK_EX)
            self.ask(method, *arguments)
            return self.answer()

    def ask(self, method: str, *arguments: Any) -> None:
        content = pickle.dumps(arguments)
        self.memory[0:64] = method.encode().ljust(64, b"\0")
        self.memory[136 : 136 + len(content)] = content
        self.memory[128:136] = struct.pack("<Q", len(content))
        self.memory[100:108] = struct.pack("<q", 1)
        os.kill(self._pid, signal.SIGUSR1)

    def status(self) -> int:
        return int(struct.unpack("<q", self.memory[100:108])[0])

    def answer(self) -> Any:
        for _ in range(10_000):
            if self.status() != 1:
                break
            select.select([], [], [], 0.001)  # shared memory wakes no thread
        if self.status() != 0:
            raise RuntimeError(f"status {self.status()}")
        length = struct.unpack("<Q", self.memory[128:136])[0]
        return pickle.loads(self.memory[136 : 136 + length])

    def close(self) -> None:
        self.memory.close()


def client(address: str) -> SocketClient | MemoryClient:
    return MemoryClient(address) if address.startswith("shm") else SocketClient(address)
