"""Files that must survive: atomic files, saved memory, threads that write, the packet log; and file formats.

**Theory of operation.** The scheduler appends every packet to the packet log before it publishes it. Cache, record and
resume are derived from that log, so they can't contradict each other.

    comes in      packets, states, memories
    state         segments of the log, of which those that are recorded are written over
    goes out      the packets from a position on; values of files
    always holds  a file is either the old or the new one, never half of it (`atomic`); a kill loses nothing, a power
                  cut at most the last tenths of a second; a slow disk never delays control (`disk`)

`formats/` reads and writes file formats that no single maker owns; readers of a maker's own formats belong to its
plug-in.
"""
