"""The bridge to the published implementation: its programs join an experiment of ours, and its files are read.

Theory of operation
-------------------

Programs of the published implementation speak version 1 of the protocol: the messages of the paper, over plain TCP,
without ids, keys or heartbeats, one request at a time. They end over an envelope or a request number that they do not
know, and look at one message a poll of about 0.4 s. A process of this package stands between such programs and ours.
Outside it binds or connects to the addresses that these programs know, and speaks version 1; inside it is an ordinary
client, translator or scheduler of ours.

| class | outside | inside |
| --- | --- | --- |
| `PublishedPeers` | ROUTER and XPUB: the scheduler that their components know | one client of ours for each peer |
| … with `as_translator` | the same: the translator that their scheduler knows | one client of ours, in control |
| `PublishedTranslator` | DEALER and SUB: their translator is asked and listened to | a translator of ours |
| `PublishedScheduler` | one DEALER for each client, and SUB: their scheduler | a scheduler of ours |

What always holds: nothing that version 1 does not have goes outside (`version_1`); a request goes outside once, since
their side knows no ids; an answer carries inside the id of its request; to a subscriber outside, times increase and
what passes quickly is paced (`pacing`).

Experiment files of the published form become ours as they are read (`files`), and `afspm check --explain` writes them
in our form (`short_form`). Nothing is imported here: a file is read without the sockets of the bridge.
"""
