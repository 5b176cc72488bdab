"""Sockets between processes: packets, requests and answers, keys, heartbeats. The only package that uses ZeroMQ.

**Theory of operation.** Packets flow one way, requests the other.

    inputs        packets of one publisher (`subscriber`), requests (`router`, `zmq_server`), answers (`control_client`,
                  `scheduler_sockets`)
    state         the connected peers and their names; for each subscriber, the time up to which it has all packets
    outputs       events of a port (`port`): PacketReceived, RequestReceived, ParentGone …, in one poller per process
    invariants    each packet arrives once and in order; after a lost connection the publisher replays missed packets as
                  far as they are kept; no send waits for a peer; with keys, a socket accepts only this experiment's
                  processes

A late or restarted subscriber sends a marker with the time of its newest packet. The publisher then replays the kept
packets after this time (`late_joiners`). `process/` is the child's side of supervision: the context in which a
component runs, the bond to its parent, log, signals.
"""
