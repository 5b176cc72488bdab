"""Any bytes under any suffix are refused with a name, or give sensible content.

They are pieces of small files in the controllers' formats, with numbers that no file should have. No reader may take
more memory or time than the file's size justifies.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.unit.storage import damage
from tests.unit.storage.corpus import to_damage, whole
from tests.unit.storage.samples import WHOLE

import afspm
from afspm.storage.formats import suffixes


@settings(max_examples=200, suppress_health_check=[HealthCheck.too_slow])
@given(damage.pieces([*WHOLE]), st.sampled_from(sorted(suffixes())))
def test_pieces_of_files_are_refused_or_make_sense(pieces: list[bytes], suffix: str) -> None:
    damage.require_sense(b"".join(pieces), f"file{suffix}")


@pytest.mark.parametrize("name", to_damage(WHOLE))
@settings(max_examples=10, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_impossible_number_is_refused_or_makes_sense(name: str, data: st.DataObject) -> None:
    damage.require_sense_of_numbers(name, data)


@pytest.mark.parametrize("name", [name for name in WHOLE if name.endswith(damage.FIXED)])
@settings(max_examples=10, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_impossible_size_is_refused_or_makes_sense(name: str, data: st.DataObject) -> None:
    damage.require_sense_of_sizes(name, data)


def test_a_spectrum_at_no_place_has_no_position(tmp_path: Path) -> None:
    for number, text in enumerate((b"NaN", b"Inf", b"1e999")):
        path = tmp_path / f"{number}.dat"
        path.write_bytes(whole("spectrum.dat").replace(b"300E-9", text))
        (curve,) = afspm.read(path).spectra
        assert curve.position_m is None
