"""Bridge to the published implementation: its programs can join an afspm experiment.

Theory of operation
-------------------

Programs of the published implementation ("peers") speak version 1 of the protocol: the messages of the paper, over
plain TCP, without ids, keys or heartbeats, one request at a time. They end on an unknown envelope or request number,
and process one message per poll of about 0.4 s. A process of this package connects peers and afspm. Outside (towards
the peers) it binds or connects to the addresses that the peers know, and speaks version 1. Inside (towards afspm) it is
an ordinary client, translator or scheduler.

| class | outside | inside |
| --- | --- | --- |
| `PublishedPeers` | ROUTER and XPUB, as the scheduler of the peers | one client for each peer |
| … with `as_translator` | the same, as the translator of a peer scheduler | one client, in control |
| `PublishedTranslator` | DEALER and SUB, as the scheduler of a peer translator | a translator |
| `PublishedScheduler` | one DEALER for each client, and SUB, as clients of a peer scheduler | a scheduler |

What always holds: only messages of version 1 go outside (`version_1`). A request is sent outside only once, since peers
have no request ids; inside, its answer has the id of the request. Subscribers outside see increasing times, and packets
that a peer would miss are delayed (`version_1.Pacing`).

The bridge is a process, and no adapter in the core's sockets: with the adapter 34 modules mentioned version 1, and one
slow peer delayed all subscribers. The price is about a millisecond for each request. Every peer is a client of its own
inside (with keys as `<bridge>:<peer>`): between the peers of one common client, control would not be arbitrated. A
packet that a peer had not yet received when the bridge dies is lost to this peer.
"""
