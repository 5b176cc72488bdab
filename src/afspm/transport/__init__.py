"""Sockets between processes: packets, requests and answers, keys, heartbeats. The only room that knows ZeroMQ.

**Theory of operation.** Packets flow one way, requests the other.

    comes in      packets of one publisher (`subscriber`), requests (`router`, `zmq_server`), answers (`control_client`,
                  `translator_link`)
    state         who is connected under which name; up to which time a subscriber has everything
    goes out      events of a port (`port`): PacketReceived, RequestReceived, ParentGone …, in one poller per process
    always holds  each packet arrives once and in order, or the subscriber learns that some are missing; nobody is
                  waited for; a socket accepts only this experiment's processes

A subscriber that joins late, or was restarted, sends a marker with the time of its newest packet, and the publisher
replays what it still has from there on (`late_joiners`). `process/` is the child's side of supervision: the context
that a component runs in, the bond to its parent, log, signals.
"""
