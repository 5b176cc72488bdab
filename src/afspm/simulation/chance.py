"""Random numbers as a pure function: the same seed and keys give the same draw, in any order of calls.

An unbounded surface and a drift defined at any time need this: the content of cell (i, j) is hashed from (seed, i, j),
not drawn from a sequence. The hash is the finaliser of splitmix64 (Steele, Lea & Flood 2014).
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

Hashes = NDArray[np.uint64]
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def subseed(seed: int, name: str) -> int:
    """Return a separate seed for a part of the world, so that its draws do not affect other parts."""
    return int(hashes(seed, zlib.crc32(name.encode()))[()])


def hashes(seed: int, *keys: ArrayLike) -> Hashes:
    """Return a 64-bit hash for each combination of integer keys, which broadcast."""
    with np.errstate(over="ignore"):  # overflow is intended: arithmetic modulo 2**64
        state = _mix(np.asarray(seed % 2**64, dtype=np.uint64))
        for key in keys:
            state = _with(state, key)
        return state


def uniform(seed: int, *keys: ArrayLike) -> NDArray[np.float64]:
    """Return uniform random numbers in [0, 1), in the broadcast shape of the keys."""
    return _fraction(hashes(seed, *keys))


def normal(seed: int, *keys: ArrayLike) -> NDArray[np.float64]:
    """Return standard normal random numbers (Box and Muller), in the broadcast shape of the keys."""
    state = hashes(seed, *keys)
    with np.errstate(over="ignore"):
        first, second = 1.0 - _fraction(_with(state, 0)), _fraction(_with(state, 1))
    result: NDArray[np.float64] = np.sqrt(-2.0 * np.log(first)) * np.cos(2.0 * np.pi * second)
    return result


def whole(seed: int, low: int, high: int, *keys: ArrayLike) -> NDArray[np.int64]:
    """Return uniform random integers in [low, high], in the broadcast shape of the keys."""
    return low + (uniform(seed, *keys) * (high - low + 1)).astype(np.int64)


def generator(seed: int, *keys: int) -> np.random.Generator:
    """Return a generator for a sequence of draws, seeded by integers."""
    return np.random.Generator(np.random.PCG64(int(hashes(seed, *keys)[()])))


def _fraction(values: Hashes) -> NDArray[np.float64]:
    return (values >> np.uint64(11)).astype(np.float64) * 2.0**-53


def _with(state: Hashes, key: ArrayLike) -> Hashes:
    whole = np.asarray(key).astype(np.int64).astype(np.uint64)
    return _mix((whole + np.uint64(1)) * _GOLDEN ^ state)


def _mix(values: Hashes) -> Hashes:
    values = values + _GOLDEN
    values ^= values >> np.uint64(30)
    values *= np.uint64(0xBF58476D1CE4E5B9)
    values ^= values >> np.uint64(27)
    values *= np.uint64(0x94D049BB133111EB)
    values ^= values >> np.uint64(31)
    return values
