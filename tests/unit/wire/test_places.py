"""A message in other coordinates: only its place changes."""

from __future__ import annotations

import numpy as np
import pytest

from afspm import wire
from afspm.basics.errors import WireError
from afspm.model import ProbePosition, Region, Scan, ScanParameters, Spectrum
from afspm.wire.generated.scan_pb2 import Scan2d
from afspm.wire.values import with_zeros, without_values

HERE = Region((1e-6, 2e-6), (3e-6, 1e-6), 0.1)
THERE = Region((-4e-6, 5e-6), (3e-6, 1e-6), 0.3)
VALUES = np.array([[0.0, -0.0, 1e-300], [np.nan, 5.0, -1.5]])


def test_a_scan_keeps_its_values_to_the_last_bit() -> None:
    name, payload = wire.encode(Scan(HERE, "Height", "m", VALUES, 123_456_789, "a.nc"))
    moved = wire.relocated(name, payload, wire.encode_place(THERE))
    assert moved.endswith(VALUES.tobytes())
    scan = wire.decode(name, moved)
    assert scan.values.tobytes() == VALUES.tobytes()
    assert (scan.channel, scan.unit, scan.time_ns, scan.filename) == ("Height", "m", 123_456_789, "a.nc")
    np.testing.assert_allclose(scan.region.corners_m(), THERE.corners_m(), rtol=1e-14)
    assert wire.relocated(name, moved, wire.encode_place(HERE)) == payload


def test_a_scan_whose_values_are_not_packed_keeps_them_too() -> None:
    name, payload = wire.encode(Scan(HERE, "Height", "m", np.ones((1, 2)), None))
    rest = Scan2d.FromString(payload)
    rest.ClearField("values")
    one = np.ones(1).tobytes()
    unpacked = rest.SerializeToString() + b"".join(bytes([4 << 3 | 1]) + one for _ in range(2))
    assert wire.relocated(name, unpacked, wire.encode_place(HERE)) == payload


def test_zeros_replace_values_and_nothing_else() -> None:
    scan = Scan(HERE, "Height", "m", VALUES, 123_456_789, "a.nc")
    spectrum = Spectrum((1e-6, 2e-6), "IV", ("V", "I"), ("V", "A"), np.arange(6.0).reshape(3, 2), 7, "b.nc")
    for one in (scan, spectrum):
        name, payload = wire.encode(one)
        zeros = with_zeros(name, payload)
        assert len(zeros) == len(payload)
        assert without_values(name, zeros) == without_values(name, payload)
        np.testing.assert_array_equal(wire.decode(name, zeros).values, np.zeros_like(one.values))
    name, payload = wire.encode(ProbePosition((0.1, 0.2)))
    assert with_zeros(name, payload) == payload


def test_a_scan_without_values_has_none_afterwards() -> None:
    name, payload = wire.encode(Scan(HERE, "Height", "m", np.empty((0, 0))))
    assert wire.decode(name, wire.relocated(name, payload, wire.encode_place(THERE))).values.size == 0


def test_a_spectrum_keeps_its_curves() -> None:
    curves = np.arange(6.0).reshape(3, 2)
    name, payload = wire.encode(Spectrum((1e-6, 2e-6), "IV", ("V", "I"), ("V", "A"), curves, 7, "b.nc"))
    moved = wire.decode(name, wire.relocated(name, payload, wire.encode_place(ProbePosition((3e-6, -1e-6)))))
    assert moved.position_m == (3e-6, -1e-6)
    np.testing.assert_array_equal(moved.values, curves)
    assert (moved.kind, moved.time_ns, moved.filename) == ("IV", 7, "b.nc")


def test_requested_place_is_returned_in_its_own_unit() -> None:
    asked = wire.encode(ScanParameters(HERE, (64, 128), "nm"))[1]
    set_ = wire.encode(ScanParameters(THERE, (32, 128), "m"))[1]
    told = wire.relocated("ScanParameters2d", set_, wire.place_in("ScanParameters2d", asked))
    assert wire.place_in("ScanParameters2d", told) == wire.place_in("ScanParameters2d", asked)
    assert wire.decode("ScanParameters2d", told).shape == (32, 128)
    position = wire.encode(ProbePosition((0.1, 0.2)))[1]
    assert wire.relocated("ProbePosition", wire.encode(ProbePosition((5.0, 5.0)))[1], position) == position


@pytest.mark.parametrize("name", ["Scan2d", "Spec1d", "ScanParameters2d"])
def test_bytes_of_another_message_are_refused(name: str) -> None:
    with pytest.raises(WireError):
        wire.relocated(name, b"\x0a\xff\xff", wire.encode_place(HERE))


def test_a_message_without_a_place_has_none_to_change() -> None:
    with pytest.raises(WireError, match="no place"):
        wire.relocated("ScopeStateMsg", b"", wire.encode_place(HERE))
