from __future__ import annotations

import numpy as np
import pytest

from afspm.drawing.curves import profile


def test_profile_has_lengths_in_metres_and_the_values_on_the_line() -> None:
    values = np.arange(21.0)[None, :] + 100 * np.arange(11.0)[:, None]
    distances_m, found = profile(values, (2e-6, 1e-6), (0.0, 0.0), (20.0, 10.0))
    assert distances_m[0] == 0.0
    assert distances_m[-1] == pytest.approx(np.hypot(2e-6, 1e-6))
    assert found[0] == 0.0
    assert found[-1] == 1020.0
    assert np.allclose(np.diff(found), np.diff(found)[0])


def test_profile_beyond_the_border_ends_at_the_border() -> None:
    _, found = profile(np.arange(9.0).reshape(3, 3), (1e-6, 1e-6), (-5.0, 1.0), (50.0, 1.0))
    assert found.tolist() == [3.0, 4.0, 5.0]


def test_profile_beside_missing_lines_has_values() -> None:
    values = np.ones((4, 4))
    values[2:] = np.nan
    _, found = profile(values, (1e-6, 1e-6), (0.0, 1.0), (3.0, 1.0))
    assert found.tolist() == [1.0] * 4
    assert np.isnan(profile(values, (1e-6, 1e-6), (0.0, 3.0), (3.0, 3.0))[1]).all()
