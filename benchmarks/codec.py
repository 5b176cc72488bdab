"""Encoding and decoding a scan of 512² against copying its bytes."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from time import perf_counter

import numpy as np

from afspm import wire
from afspm.model import Region, Scan
from benchmarks.effort import effort
from benchmarks.rows import Row, measurement


def scan(pixels: int) -> Scan:
    """Return a square scan of noise."""
    values = np.random.default_rng(1).normal(size=(pixels, pixels))
    return Scan(Region((0.0, 0.0), (2e-6, 2e-6)), "Height", "m", values, 1_800_000_000_000_000_000)


def _timed(work: Callable[[], object], repeats: int = effort(20, 1)) -> float:
    began = perf_counter()
    for _ in range(repeats):
        work()
    return (perf_counter() - began) / repeats * 1e6


@measurement
def codec() -> Iterator[Row]:
    """Compare with a copy into fresh memory, which encoding also needs."""
    subject = scan(512)
    source = subject.values.tobytes()
    payload = wire.encode(subject)[1]
    times = [
        (
            _timed(lambda: wire.encode(subject)),
            _timed(lambda: bytearray(source)),
            _timed(lambda: wire.decode("Scan2d", payload)),
        )
        for _ in range(effort(15, 1))
    ]
    encoding, copying, decoding = (statistics.median(t) for t in zip(*times, strict=True))
    yield Row("encode a scan of 512², against a memcpy", "µs", encoding, copying, 2.0)
    yield Row("decode a scan of 512², against a memcpy", "µs", decoding, copying, 2.0)
    shared = np.shares_memory(wire.decode("Scan2d", payload).values, np.frombuffer(payload, np.uint8))
    yield Row("decoding copies the values", "times", 0.0 if shared else 1.0, None, 0.0)
