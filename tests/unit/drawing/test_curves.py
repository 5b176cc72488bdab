from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from afspm.drawing.curves import round_ticks, thinned


def test_peaks_survive_thinning() -> None:
    y = np.zeros(100_000)
    y[31_234] = 5.0
    x, thin = thinned(np.arange(100_000.0), y)
    assert thin.max() == 5.0
    assert len(thin) <= 700
    assert (np.diff(x) > 0).all()


def test_ticks_are_round_and_inside() -> None:
    assert round_ticks(-0.26, 1.03) == [-0.2, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0] or round_ticks(-0.26, 1.03) == [
        0.0,
        0.5,
        1.0,
    ]
    for low, high in ((1e-9, 3e-9), (-7.0, 1000.0), (5.0, 5.0)):
        assert all(low - 1e-9 * high <= tick <= high * (1 + 1e-9) for tick in round_ticks(low, high))


@given(st.floats(-1e3, 1e3), st.floats(1e-6, 1e3), st.integers(3, 8))
def test_there_are_never_too_few_or_too_many_ticks(low: float, extent: float, about: int) -> None:
    assert 2 <= len(round_ticks(low, low + extent, about)) <= 2 * about + 2
