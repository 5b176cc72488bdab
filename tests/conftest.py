"""For all tests."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zmq
from hypothesis import settings

# how long one example takes says more about how busy the computer is than about us
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None)  # new examples each time: AFSPM_EXAMPLES=explore make test
settings.load_profile(os.environ.get("AFSPM_EXAMPLES", "repeatable"))

# as for a registration in an experiment: on small arrays several threads are slower than one, and take others' cores
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# a shell that runs the tests in the background ignores Ctrl-C for them, and so would everything that they start
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """What thousands of tests are made of is there to the end: garbage is not looked for in it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def plain() -> Iterator[Callable[..., Any]]:
    """`plain(zmq.SUB)`: a socket as a peer of version 1 has it, with nothing of ours."""
    context: zmq.Context[Any] = zmq.Context()
    sockets = []  # or those that a test holds no name for are closed

    def socket(kind: int) -> Any:
        made = context.socket(kind)
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.RCVTIMEO, 10_000)
        sockets.append(made)
        return made

    yield socket
    context.destroy(linger=0)
