"""Files that afspm writes where a controller saves none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import netcdf_file

from afspm import read
from afspm.model import Region, Spectrum
from afspm.model.variables import VariableRoles
from afspm.translator.own_files import FileFacts, encode_scan, encode_spectrum

FACTS = FileFacts(1_750_000_000_000_000_000, {})


def test_roles_of_a_curve_are_kept_beside_the_names_of_its_maker(tmp_path: Path) -> None:
    roles = VariableRoles.declared({"height": ["Ext"], "current": ["I(V)"]}, towards=["Ext"])
    values = np.arange(6.0).reshape(3, 2)
    curve = Spectrum(None, "IZ", ("Ext", "I(V)"), ("m", "A"), values, declared_roles=roles)
    (tmp_path / "a.nc").write_bytes(encode_spectrum(curve, FACTS))
    (found,) = read(tmp_path / "a.nc").spectra
    assert found.names == curve.names
    assert found.of("height") == pytest.approx(-values[:, 0])
    assert found.of("current") == pytest.approx(values[:, 1])
    with netcdf_file(tmp_path / "a.nc", mmap=False) as others:
        assert vars(others.variables["ext"])["role"] == b"height"


@pytest.mark.parametrize("names", [("Bias", "In", "In"), ("Bias", "In 1", "In-1")])
def test_two_variables_of_one_name_are_both_kept(names: tuple[str, ...], tmp_path: Path) -> None:
    values = np.arange(9.0).reshape(3, 3)
    (tmp_path / "a.nc").write_bytes(encode_spectrum(Spectrum(None, "IV", names, ("V", "A", "A"), values), FACTS))
    (found,) = read(tmp_path / "a.nc").spectra
    assert found.values == pytest.approx(values)
    assert found.names == (*names[:2], "In #2" if names[1] == names[2] else names[2])


def test_roles_of_channels_are_kept_and_like_names_stay_apart(tmp_path: Path) -> None:
    region, values = Region((0.0, 0.0), (1e-6, 1e-6)), np.arange(4.0).reshape(2, 2)
    channels = {"Z 1": ("m", values), "Z-1": ("m", values + 1.0), "x": ("V", values + 2.0)}
    (tmp_path / "a.nc").write_bytes(encode_scan(region, channels, FACTS, {"Z 1": ("height", "topography")}))
    found = read(tmp_path / "a.nc").scans
    assert [one.channel for one in found] == list(channels)
    assert [one.roles for one in found] == [("height", "topography"), (), ()]
    assert [one.values[0, 0] for one in found] == [0.0, 1.0, 2.0]
