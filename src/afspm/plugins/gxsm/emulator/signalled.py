"""Owner process of Gxsm4's shared memory, which receives the signals and passes calls to the emulator.

`block.py` starts this file as a separate script, with the name of the block and of the process; the process ends when
standard input ends. Frames have a length and a content. Calls go to standard output: the function's name in 64 bytes,
and the pickled arguments. Answers come from standard input: a status of 8 bytes, a length of 8 bytes, and the pickled
result.

An existing block is reused unchanged, even with an unanswered request. One call is passed on at a time: a request that
overwrites an earlier request receives the answer to the earlier request.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import signal
import struct
import sys
from pathlib import Path

SIZE = 16_777_344
STATUS, LENGTH, CONTENT = 100, 128, 136


def read(count: int) -> bytes:
    content = b""
    while len(content) < count:
        part = os.read(0, count - len(content))
        if not part:
            raise EOFError
        content += part
    return content


def passed_on(memory: mmap.mmap) -> bool:
    """Pass on the request in the block to the emulator; return False without a request."""
    if struct.unpack_from("<q", memory, STATUS)[0] != 1:
        return False
    length = struct.unpack_from("<I", memory, LENGTH)[0]
    call = memory[:64] + memory[CONTENT : CONTENT + min(length, SIZE - CONTENT)]
    sys.stdout.buffer.write(struct.pack(">I", len(call)) + call)
    sys.stdout.buffer.flush()
    return True


def answered(memory: mmap.mmap) -> None:
    """Copy an answer from standard input to the block, with the status last."""
    answer = read(struct.unpack(">I", read(4))[0])
    memory[CONTENT : CONTENT + len(answer) - 16] = answer[16:]
    memory[LENGTH : LENGTH + 8] = answer[8:16]
    memory[STATUS : STATUS + 8] = answer[:8]


def run(block: str, name: str) -> None:
    woken, wakes = os.pipe2(os.O_NONBLOCK)
    signal.signal(signal.SIGUSR1, lambda *_: None)
    signal.set_wakeup_fd(wakes)
    Path("/proc/self/comm").write_text(name)
    descriptor = os.open(f"/dev/shm/{block}", os.O_RDWR | os.O_CREAT, 0o644)
    os.ftruncate(descriptor, SIZE)
    memory = mmap.mmap(descriptor, SIZE)
    sys.stdout.buffer.write(struct.pack(">I", 0))
    sys.stdout.buffer.flush()
    asked = False
    while True:
        # one call at a time: the emulator does not read while it writes an answer, and both would block
        ready = select.select([0] if asked else [0, woken], [], [])[0]
        if 0 in ready:
            answered(memory)
            asked = False
        if woken in ready:
            os.read(woken, 4096)
            asked = passed_on(memory)


if __name__ == "__main__":
    with contextlib.suppress(EOFError, OSError):
        run(*sys.argv[1:])
