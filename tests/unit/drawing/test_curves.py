from __future__ import annotations

import numpy as np

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
