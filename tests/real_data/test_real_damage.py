"""Cut and damaged files of real microscopes, one of each kind, and pieces of them."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.unit.storage import damage
from tests.unit.storage.corpus import to_damage
from tests.unit.storage.samples import WHOLE

from afspm.storage.formats import suffixes

REAL = (
    "asylum/DTMicroscope_scan_0001.ibw",
    "asylum/PMN28Pt0000.h5",
    "asylum/fmt-igor-fd_SiN_FD_plot.ibw",
    "gxsm/gxsm3/scan002-M-Xp-Topo.nc",
    "gxsm/gxsm4/scan002-M-Xp-ZSmTopo.nc",
    "gxsm/gxsm4/scan006-VP001-VP.vpdata",
    "nanonis/Bias-Spectroscopy002.dat",
    "nanonis/ProbeFlow_nanonis.sxm",
)
TO_CUT = tuple(name for name in REAL if not name.endswith(".h5"))


@settings(max_examples=200, suppress_health_check=[HealthCheck.too_slow])
@given(damage.pieces([*WHOLE, *REAL]), st.sampled_from(sorted(suffixes())))
def test_pieces_of_real_files_are_refused_or_make_sense(pieces: list[bytes], suffix: str) -> None:
    damage.require_sense(b"".join(pieces), f"file{suffix}")


@pytest.mark.parametrize("name", to_damage(REAL))
@settings(max_examples=10, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_impossible_number_in_a_real_file_is_refused_or_makes_sense(name: str, data: st.DataObject) -> None:
    damage.require_sense_of_numbers(name, data)


@pytest.mark.parametrize("name", [name for name in REAL if name.endswith(damage.FIXED)])
@settings(max_examples=10, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_impossible_size_in_a_real_file_is_refused_or_makes_sense(name: str, data: st.DataObject) -> None:
    damage.require_sense_of_sizes(name, data)


@pytest.mark.parametrize("name", TO_CUT)
@settings(max_examples=20)
@given(data=st.data())
def test_real_file_that_was_cut_off_is_refused_or_holds_the_same(name: str, data: st.DataObject) -> None:
    damage.require_same_or_refusal_of_cut(name, data)


@pytest.mark.parametrize("name", [name for name in TO_CUT if not name.endswith(".dat")])
def test_values_that_are_cut_off_a_real_file_are_refused(name: str) -> None:
    damage.require_refusal_without_values(name)


@pytest.mark.parametrize("name", to_damage(TO_CUT))
@settings(max_examples=30)
@given(data=st.data())
def test_damaged_bytes_of_a_real_file_are_refused_or_read(name: str, data: st.DataObject) -> None:
    damage.require_values_or_refusal_of_damaged(name, data)
