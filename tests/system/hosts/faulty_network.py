"""A network in user space between hosts that are network namespaces: it delays, loses, doubles, reorders and cuts.

Each host has a TUN device; this reads the IP packets that one sends and writes them to the host that has the address.
(As `tc netem` does, which not every kernel has; and seeded, with each direction of each pair on its own.)
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
import random
import selectors
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

_LONGEST_PACKET = 65536
_BATCH = 64


@dataclass
class Link:
    """One direction between two hosts.

    Attributes:
        delay_s, jitter_s: each packet takes the delay and at most the jitter more, so that packets overtake each other.
        loss, duplication: parts of the packets (0 to 1).
        bytes_per_s: the rate; what does not fit into `queue_s` of it is dropped, as a router does.
        up: packets arrive at all.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    duplication: float = 0.0
    bytes_per_s: float | None = None
    queue_s: float = 0.3
    up: bool = True
    _free_at_s: float = 0.0

    def departures(self, size: int, now_s: float, chance: random.Random) -> Iterator[float]:
        """Yield when a packet arrives: never, once, or twice."""
        if not self.up or chance.random() < self.loss:
            return
        if self.bytes_per_s is not None:
            self._free_at_s = max(self._free_at_s, now_s)
            if self._free_at_s - now_s > self.queue_s:
                return
            self._free_at_s += size / self.bytes_per_s
            now_s = self._free_at_s
        for _ in range(2 if chance.random() < self.duplication else 1):
            yield now_s + self.delay_s + chance.random() * self.jitter_s


class FaultyNetwork:
    """Carries packets between hosts, in a thread of its own, until it is closed."""

    def __init__(self, seed: int = 1) -> None:
        self._chance = random.Random(seed)
        self._links: dict[tuple[str, str], Link] = {}
        self._addresses: dict[bytes, str] = {}
        self._devices: dict[str, int] = {}
        self._waiting: list[tuple[float, int, str, bytes]] = []
        self._numbers = itertools.count()
        self._selector = selectors.DefaultSelector()
        self._lock = threading.Lock()
        self._stop, self._stopped = socket.socketpair()
        self._selector.register(self._stopped, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="network", daemon=True)
        self._thread.start()

    def plug(self, host: str, device: int, address: str) -> None:
        """Connect a host by the descriptor of its TUN device."""
        os.set_blocking(device, False)
        with self._lock:
            self._devices[host] = device
            self._addresses = {known: other for known, other in self._addresses.items() if other != host}
            self._addresses[socket.inet_aton(address)] = host
            self._selector.register(device, selectors.EVENT_READ, host)
        self._stop.send(b".")

    def unplug(self, host: str) -> None:
        """Disconnect a host: nothing of what is on its way arrives."""
        with self._lock:
            if (device := self._devices.pop(host, None)) is not None:
                self._selector.unregister(device)
                os.close(device)

    def readdress(self, host: str, address: str) -> None:
        """Deliver to a host what is for another address than before."""
        with self._lock:
            self._addresses = {known: other for known, other in self._addresses.items() if other != host}
            self._addresses[socket.inet_aton(address)] = host

    def link(self, sender: str, receiver: str) -> Link:
        """Return one direction between two hosts, to be changed as one likes."""
        return self._links.setdefault((sender, receiver), Link())

    @contextlib.contextmanager
    def cut(self, *directions: tuple[str, str]) -> Iterator[None]:
        """Let nothing through in these directions while in the block."""
        self._set_up(directions, up=False)
        try:
            yield
        finally:
            self._set_up(directions, up=True)

    def _set_up(self, directions: tuple[tuple[str, str], ...], *, up: bool) -> None:
        for sender, receiver in directions:
            self.link(sender, receiver).up = up

    def close(self) -> None:
        """Stop, and close all devices."""
        self._stop.close()
        self._thread.join()
        for host in list(self._devices):
            self.unplug(host)
        self._stopped.close()
        self._selector.close()

    def _run(self) -> None:
        while True:
            timeout_s = max(0.0, self._waiting[0][0] - time.monotonic()) if self._waiting else None
            for key, _ in self._selector.select(timeout_s):
                if key.fileobj is self._stopped:
                    if not self._stopped.recv(4096):
                        return
                else:
                    self._take(int(key.fd), str(key.data))
            self._deliver()

    def _take(self, device: int, sender: str) -> None:
        for _ in range(_BATCH):
            try:
                packet = os.read(device, _LONGEST_PACKET)
            except OSError:
                return
            receiver = self._addresses.get(packet[16:20])  # of an IPv4 header: the destination
            if receiver is None:
                continue
            for due_s in self.link(sender, receiver).departures(len(packet), time.monotonic(), self._chance):
                heapq.heappush(self._waiting, (due_s, next(self._numbers), receiver, packet))

    def _deliver(self) -> None:
        now_s = time.monotonic()
        while self._waiting and self._waiting[0][0] <= now_s:
            *_, receiver, packet = heapq.heappop(self._waiting)
            with self._lock, contextlib.suppress(OSError):  # a full device drops, as cards do
                if (device := self._devices.get(receiver)) is not None:
                    os.write(device, packet)
