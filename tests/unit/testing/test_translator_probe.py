"""The suite for translators moves the probe in its first frame, independently of the frames of its scans."""

from __future__ import annotations

from typing import Any, cast

import pytest

from afspm.model import ControlRequest, Region, ScanParameters
from afspm.testing.translators.client import CheckClient
from afspm.testing.translators.measuring import CheckMeasurements
from afspm.testing.translators.support import Support

WHOLE = ScanParameters(Region((0.0, 0.0), (1e-6, 1e-6)), (64, 64), None)
LEFT = ScanParameters(Region((3e-7, 3e-7), (1e-7, 1e-7)), (16, 64), None)


class Client:
    """A client of a microscope, with the settings in force there."""

    def __init__(self) -> None:
        self.in_force = WHOLE
        self.requests: list[tuple[ControlRequest, Any]] = []
        self.observations = self

    def newest(self, _: type) -> ScanParameters:
        return self.in_force

    def mark(self) -> int:
        return 0

    def come_to_rest(self) -> None: ...

    def settled(self, _: int, **_awaiting: object) -> list[Any]:
        return []

    def asked(self, kind: ControlRequest, subject: Any, _: str) -> None:
        self.requests.append((kind, subject))


@pytest.mark.parametrize(("left", "frames"), [(WHOLE, 0), (LEFT, 1)], ids=["as it began", "of a scan that failed"])
def test_probe_is_moved_in_the_first_frame(left: ScanParameters, frames: int) -> None:
    client = Client()
    kit = CheckMeasurements(cast(CheckClient, client), Support())
    client.in_force = left
    kit.move_probe((-2e-7, 0.0))
    kinds = [kind for kind, _ in client.requests]
    assert kinds == [ControlRequest.SET_SCAN_PARAMS] * frames + [ControlRequest.SET_PROBE_POS]
    if frames:
        region = client.requests[0][1].region
        assert (region.left_m, region.width_m) == pytest.approx((-5e-7, 1e-6))
        assert client.requests[0][1].shape == LEFT.shape
