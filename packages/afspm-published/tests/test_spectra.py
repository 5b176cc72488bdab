"""Spectra of the published translators for Nanonis and Asylum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from afspm import wire
from afspm.model import Spectrum
from afspm_published.translator import by_point


@pytest.mark.parametrize("shape", [(5, 2), (2, 5), (1, 3), (4, 1), (0, 2)])
def test_a_spectrum_sent_variable_by_variable_is_reordered(shape: tuple[int, int]) -> None:
    points, variables = shape
    values = np.arange(float(points * variables)).reshape(shape)
    names = tuple(f"v{n}" for n in range(variables))
    right = Spectrum((1e-9, 2e-9), "IV", names, ("V",) * variables, values, 1_700_000_000_000_000_001, "a.dat")
    scrambled = wire.encode(replace(right, values=values.T.copy().reshape(shape)))[1]
    assert by_point(scrambled) == wire.encode(right)[1]
