"""Sockets between processes: packets, requests and answers, keys, heartbeats. The only package that uses ZeroMQ.

**Theory of operation.** Packets flow one way, requests the other. A microscope publishes some packets a second, at most
a hundred with live lines, so the public calls of pyzmq are enough: one poller a process, and a bounded number of
messages from a socket before the next. The ROUTER socket takes requests from its clients in turn, so a flooding client
costs the others only a share. Queues and polling of afspm's own were faster for thousands of packets a second.

    inputs        packets of one publisher (`subscriber`), requests (`router`, `zmq_server`), answers (`control_client`,
                  `scheduler_sockets`)
    state         the connected peers and their names; for each subscriber, the time up to which it has all packets
    outputs       events of a port (`port`): PacketReceived, RequestReceived, ParentGone …, in one poller per process
    invariants    each packet arrives once and in order; after a lost connection, or a full queue, the publisher replays
                  missed packets as far as they are kept; no send waits for a peer; with keys, a socket accepts only
                  this experiment's processes

A late or restarted subscriber sends a marker with the time of its newest packet. The publisher then replays the kept
packets after this time (`late_joiners`). A beacon each second names the newest packets, so that a subscriber finds and
requests one that was dropped on a connection that stands. `process/` is the child's side of supervision: the context
in which a component runs, the bond to its parent, log, signals.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.transport.late_joiners import PublishedHistory
    from afspm.transport.network import Network, is_local
    from afspm.transport.polling import Poller, WakeUp, milliseconds
    from afspm.transport.port import ParentGone, Port
    from afspm.transport.process.context import ProcessActivity, ProcessContext, new_session, step_back
    from afspm.transport.process.loading import find_object
    from afspm.transport.process.parent import StopRequested, leave_interrupts_to_parent
    from afspm.transport.rate_limited_log import RateLimitedLog
    from afspm.transport.router import PeerAsked, Router
    from afspm.transport.zmq_port import ZmqPort, open_port

if TYPE_CHECKING:  # a replay publishes
    from afspm.transport.publisher import Publisher

__all__ = [
    "Network",
    "ParentGone",
    "PeerAsked",
    "Poller",
    "Port",
    "ProcessActivity",
    "ProcessContext",
    "PublishedHistory",
    "Publisher",
    "RateLimitedLog",
    "Router",
    "StopRequested",
    "WakeUp",
    "ZmqPort",
    "find_object",
    "is_local",
    "leave_interrupts_to_parent",
    "milliseconds",
    "new_session",
    "open_port",
    "step_back",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.transport.late_joiners": "PublishedHistory",
            "afspm.transport.network": "Network is_local",
            "afspm.transport.polling": "Poller WakeUp milliseconds",
            "afspm.transport.port": "ParentGone Port",
            "afspm.transport.process.context": "ProcessActivity ProcessContext new_session step_back",
            "afspm.transport.process.loading": "find_object",
            "afspm.transport.process.parent": "StopRequested leave_interrupts_to_parent",
            "afspm.transport.publisher": "Publisher",
            "afspm.transport.rate_limited_log": "RateLimitedLog",
            "afspm.transport.router": "PeerAsked Router",
            "afspm.transport.zmq_port": "ZmqPort open_port",
        },
    )
