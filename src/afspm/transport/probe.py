"""Attempts to reach an address in steps: its name, the connection, ZeroMQ's greeting, the keys."""

from __future__ import annotations

import errno
import platform
import socket
from importlib.metadata import version

import zmq

from afspm.basics.clock import ExperimentClock
from afspm.transport.diagnosis import Handshake, Reach, Versions
from afspm.transport.network import CONNECTED, KEY_REFUSED, REFUSED, Monitor, Network

WITHIN_S = 5.0  # real time for each step of a test of a connection
_ZMTP = b"\xff"  # the first byte of ZeroMQ's greeting (ZMTP)
_NO_ROUTE = (errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN)


def versions_here() -> Versions:
    """Return the versions on this computer."""
    return Versions(version("afspm"), platform.python_version(), zmq.zmq_version())


def reach(address: str, within_s: float = WITHIN_S) -> Reach:
    """Return the outcome of an attempt to connect to a `tcp://` address; `within_s` limits connection and greeting.

    An address of another kind is on this computer, and only a handshake shows who is there.
    """
    if not address.startswith("tcp://"):
        return Reach.OPEN
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=within_s) as peer:
            return _greeting(peer)
    except socket.gaierror:
        return Reach.UNKNOWN_NAME
    except ConnectionRefusedError:
        return Reach.REFUSED
    except ConnectionError:
        return Reach.OTHER_PROGRAM
    except TimeoutError:
        return Reach.SILENT
    except OSError as error:
        return Reach.NO_ROUTE if error.errno in _NO_ROUTE else Reach.SILENT


def _greeting(peer: socket.socket) -> Reach:
    try:
        return Reach.OPEN if peer.recv(1) == _ZMTP else Reach.OTHER_PROGRAM
    except TimeoutError:
        return Reach.NO_GREETING


def handshake(network: Network, address: str, within_s: float = WITHIN_S) -> Handshake:
    """Return the outcome of the key exchange at a reachable address."""
    client = network.socket(zmq.DEALER)
    monitor = Monitor(network, client, CONNECTED | REFUSED)
    network.connect(client, address)
    clock = ExperimentClock.real()
    until_s, found = clock.monotonic_s() + within_s, Handshake.SILENT
    # a refusing peer may hang up before its reason arrives: try again until the time is up
    while found in (Handshake.SILENT, Handshake.FAILED) and (left_s := until_s - clock.monotonic_s()) > 0.0:
        monitor.socket.poll(round(left_s * 1000))
        for kind, _ in monitor.drain():
            found = {CONNECTED: Handshake.DONE, KEY_REFUSED: Handshake.KEY_REFUSED}.get(kind, Handshake.FAILED)
    return found


def is_of_this_computer(address: str) -> bool:
    """Return whether an address belongs to this computer."""
    host = address.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        found = {entry[4][0] for entry in socket.getaddrinfo("0.0.0.0" if host == "*" else host, None, family)}
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind((str(found.pop()), 0))
    except OSError:
        return False
    return True
