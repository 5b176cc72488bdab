"""`listener.py <address> <name>`: a component in its own process that prints the time of every scan received."""

from __future__ import annotations

import sys

from afspm.basics.clock import ExperimentClock
from afspm.transport.network import Network
from afspm.transport.port import PacketReceived
from afspm.transport.zmq_port import ZmqPort

if __name__ == "__main__":
    port = ZmqPort(Network(), sys.argv[2], ExperimentClock.real(), subscribe=[sys.argv[1]], envelopes=["Scan2d"])
    while True:
        for incoming in port.poll(None):
            if isinstance(incoming, PacketReceived):
                sys.stdout.write(f"{incoming.packet.time_ns}\n")
                sys.stdout.flush()
