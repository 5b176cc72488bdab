"""The Rescanner in the in-memory laboratory: repeated scans, their number, and the settings it leaves."""

from __future__ import annotations

from typing import Any

import pytest
from client_lab import REGION, Lab, run

from afspm import wire
from afspm.basics.errors import ConfigError
from afspm.basics.exit_codes import ExitCode
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Problem,
    Region,
    Request,
    RescanKind,
    Response,
    ScanParameters,
    names,
)
from afspm.plugins.drift.frame.rescanner import Rescanner
from afspm.wire.generated.drift_pb2 import DriftMapping, DriftRescan
from afspm.wire.generated.scan_pb2 import ScanParameters2d

DRIFT, MALFUNCTION = Problem.THERMAL_DRIFT, Problem.DEVICE_MALFUNCTION
ELSEWHERE = Region((3e-6, 1e-6), (1e-6, 0.5e-6), 0.2)


class Drifting(Lab):
    """A scheduler that publishes a given outcome for each scan: "well", "off", "lost" or "unmatched"."""

    def __init__(self, outcomes: list[str]) -> None:
        super().__init__("rescanner")
        self._outcomes = iter(outcomes)
        self.parameters = ScanParameters(REGION, (8, 8))
        self.publish(self.parameters)
        self.values[names.SCAN_DIRECTION] = names.UP
        self.directions: list[str] = []

    def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        outcome = next(self._outcomes, "well")
        self.publish(
            DriftMapping(
                matched=outcome not in ("lost", "unmatched"),
                lost=outcome == "lost",
                rescan="too far" if outcome == "off" else "",
            )
        )
        self.directions.append(self.values[names.SCAN_DIRECTION])
        super().publish_scan(region, shape)

    def wants(self, kind: int, region: Region = REGION, *, upwards: bool | None = None) -> None:
        params = ScanParameters2d.FromString(wire.encode(ScanParameters(region, (8, 8)))[1])
        message = DriftRescan(kind=kind, params=params, reason="drift", upwards=upwards)  # type: ignore[arg-type]
        message.timestamp.FromNanoseconds(self.clock.now_ns())
        self.publish(message)

    @property
    def problems(self) -> tuple[int, ...]:
        return self.control.published().problems


def asked(
    kind: int, told: list[str], region: Region = REGION, *, upwards: bool | None = None, **settings: float
) -> Drifting:
    """Run a Rescanner with one request."""
    lab = Drifting(told)
    lab.at(10.0, lambda: lab.wants(kind, region, upwards=upwards))
    lab.at(5000.0, lab.kill)
    assert run(Rescanner(**settings), lab) == ExitCode.ENDED  # type: ignore[arg-type]
    return lab


def test_the_region_is_taken_again_with_the_problem_flagged_meanwhile() -> None:
    lab = asked(RescanKind.AGAIN, ["well"], ELSEWHERE)
    assert [region.center_m for region in lab.finished] == [pytest.approx(ELSEWHERE.center_m)]
    assert lab.problems == ()
    assert lab.control.holder is None


def test_rescans_are_repeated_until_the_offset_is_small() -> None:
    assert len(asked(RescanKind.AGAIN, ["off", "unmatched", "well"]).finished) == 3


def test_experiment_goes_on_after_the_last_attempt() -> None:
    lab = asked(RescanKind.AGAIN, ["off"] * 10, attempts=2)
    assert len(lab.finished) == 2
    assert lab.problems == ()


def test_the_other_direction_is_scanned_and_the_direction_set_back() -> None:
    lab = asked(RescanKind.OPPOSITE, ["well"], upwards=False)
    assert lab.directions == [names.DOWN]
    assert lab.values[names.SCAN_DIRECTION] == names.UP
    assert lab.problems == ()


def test_opposite_direction_is_tried_once_only() -> None:
    lab = asked(RescanKind.OPPOSITE, ["unmatched"] * 3, upwards=False)
    assert len(lab.finished) == 1
    assert lab.problems == ()


@pytest.mark.parametrize("kind", [RescanKind.OPPOSITE, RescanKind.SEARCH])
def test_direction_and_region_are_restored_when_another_client_clears_the_problem(kind: int) -> None:
    lab = Drifting([])
    lab.at(10.0, lambda: lab.wants(kind, upwards=False))
    lab.at(60.0, lambda: lab.clear(DRIFT))
    lab.at(5000.0, lab.kill)
    assert run(Rescanner(), lab) == ExitCode.ENDED
    assert lab.values[names.SCAN_DIRECTION] == names.UP
    if kind == RescanKind.SEARCH:
        assert (lab.parameters.region, lab.parameters.shape) == (REGION, (8, 8))


def test_search_widens_until_the_sample_is_found_and_restores_the_region() -> None:
    lab = asked(RescanKind.SEARCH, ["lost", "unmatched", "well"])
    assert [region.size_m[0] for region in lab.finished] == pytest.approx([2e-6, 4e-6, 8e-6])
    assert {region.center_m for region in lab.finished} == {REGION.center_m}
    assert lab.problems == ()
    assert (lab.parameters.region, lab.parameters.shape) == (REGION, (8, 8))


def test_sample_that_is_not_found_is_flagged_for_a_person() -> None:
    lab = asked(RescanKind.SEARCH, ["lost"] * 10)
    assert len(lab.finished) == 3
    assert lab.problems == (MALFUNCTION,)
    told = [(r.kind, r.subject) for r in lab.requests]
    called, given_up = (ControlRequest.ADD_EXP_PRBLM, MALFUNCTION), (ControlRequest.RMV_EXP_PRBLM, DRIFT)
    assert told.index(called) < told.index(given_up), "nobody is to go on in between"


def refusing(lab: Drifting, most_m: float) -> None:
    """Refuse regions wider than this."""

    def too_wide(request: Request) -> Response | str:
        starts = lab.parameters if request.subject == "start-scan" else request.subject
        region = starts.region if isinstance(starts, ScanParameters) else None
        if isinstance(region, Region) and region.size_m[0] > most_m:
            return Response(ControlResponse.PARAM_ERROR, reason="[limits] region")
        return "go on"

    lab.intercept = too_wide


@pytest.mark.parametrize(("most_m", "widths"), [(3e-6, [2e-6, 2e-6]), (1.5e-6, [1e-6, 1e-6])])
def test_search_stays_within_its_allowed_width(most_m: float, widths: list[float]) -> None:
    lab = Drifting(["lost", "well"])
    refusing(lab, most_m)
    lab.at(10.0, lambda: lab.wants(RescanKind.SEARCH))
    lab.at(5000.0, lab.kill)
    assert run(Rescanner(), lab) == ExitCode.ENDED
    assert [region.size_m[0] for region in lab.finished] == pytest.approx(widths)
    assert lab.problems == ()


@pytest.mark.parametrize(
    ("settings", "shape", "wider"),
    [({}, (128, 64), (256, 128)), ({}, (9, 9), (17, 17)), ({"most_pixels": 200}, (128, 208), (192, 208))],
)
def test_wider_search_keeps_to_multiples_of_sixteen_pixels(
    settings: dict[str, Any], shape: tuple[int, int], wider: tuple[int, int]
) -> None:
    # Nanonis refuses 255 columns, so that no search was wider
    assert Rescanner(**settings)._wider(REGION, shape, 1)[1] == wider


@pytest.mark.parametrize(("kind", "left"), [(RescanKind.SEARCH, (MALFUNCTION,)), (RescanKind.AGAIN, ())])
def test_refused_rescan_counts_as_failed(kind: int, left: tuple[int, ...]) -> None:
    lab = Drifting([])
    refusing(lab, 0.0)
    lab.at(10.0, lambda: lab.wants(kind))
    lab.at(5000.0, lab.kill)
    assert run(Rescanner(), lab) == ExitCode.ENDED  # and did not crash over it
    assert not lab.finished
    assert lab.problems == left


def test_rescan_requested_by_its_own_scans_is_not_repeated() -> None:
    lab = Drifting(["off", "off"])
    lab.at(10.0, lambda: lab.wants(RescanKind.AGAIN))
    lab.at(10.0 + 105.0, lambda: lab.wants(RescanKind.AGAIN))  # of its first scan
    lab.at(5000.0, lab.kill)
    assert run(Rescanner(), lab) == ExitCode.ENDED
    assert len(lab.finished) == 3
    assert lab.problems == ()


@pytest.mark.parametrize("settings", [{"attempts": 0}, {"widen": 1.0}, {"most_pixels": 1}])
def test_impossible_settings_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        Rescanner(**settings)  # type: ignore[arg-type]
