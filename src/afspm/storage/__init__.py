"""Files that must survive: atomic files, saved memory, threads that write, the packet log; and file formats.

**Theory of operation.** The scheduler appends every packet to the packet log before its publication. Cache, record and
resume are derived from that log, so they can't contradict each other.

    comes in      packets, states, memories
    state         segments of the log; recorded segments are overwritten
    goes out      the packets from a position on; the content of files
    always holds  after a kill, a file has its old or its new content, never half of it (`atomic`); a kill loses
                  nothing that was written; a power cut loses the last tenths of a second of packets, and about a
                  second of memories saved without a sync; a slow disk never delays control (`disk`)

`formats/` reads and writes file formats that no single maker owns. Readers of a maker's own formats are in its
plug-in, the reader of the record's own files in `record`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.storage.packet_log import log_folder, logged_packets

__all__ = [
    "log_folder",
    "logged_packets",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.storage.packet_log": "log_folder logged_packets",
        },
    )
