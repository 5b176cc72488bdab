"""Another person or program moves the frame: its scan is not taken for the requested one."""

from __future__ import annotations

import re

import pytest
from client_lab import OTHER_REGION, REGION, SOURCE, Lab, LabPort

from afspm import model
from afspm.basics.errors import NoResponse
from afspm.client.experiment_link import ExperimentLink
from afspm.client.scope import Scope
from afspm.model import ControlRequest


def test_another_frame_is_not_taken_for_a_rounded_own_one(lab: Lab, scope: Scope) -> None:
    publish = lab.move
    lab.move = lambda thing: publish(model.ScanParameters(OTHER_REGION, (8, 8)))  # type: ignore[method-assign]
    scope.scan(REGION)
    scope.scan(REGION)
    assert lab.count(ControlRequest.SET_SCAN_PARAMS) == 2


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        (model.ScanParameters(OTHER_REGION, (8, 8)), r"1 x 1 µm at \(5, 0\) µm, 8 x 8 pixels"),
        (model.ScanParameters(REGION, (4, 4)), r"1 x 1 µm at \(0, 0\) nm, 4 x 4 pixels"),
    ],
)
def test_scan_of_another_frame_is_reported_and_taken_again(
    lab: Lab, scope: Scope, frame: model.ScanParameters, told: str
) -> None:
    def at_the_panel() -> None:
        lab.parameters = frame
        lab.publish(frame)

    lab.at(20.0, at_the_panel)
    scans = scope.scan(REGION, shape=(8, 8))
    assert (scans.region, scans.first.shape, lab.begun_scans) == (REGION, (8, 8), 2)
    assert len(scans.interruptions) == 1
    assert re.search(told, scans.interruptions[0])


def test_a_frame_that_is_never_scanned_is_given_up(lab: Lab, scope: Scope) -> None:
    def elsewhere() -> None:
        lab.publish_scan(OTHER_REGION)

    lab.finish_scan = elsewhere  # type: ignore[method-assign]
    with pytest.raises(NoResponse, match="failed 5 times: another measurement was taken"):
        scope.scan(REGION, shape=(8, 8))


@pytest.mark.parametrize(("off", "scale", "scans"), [(0.4, 1.03, 1), (0.8, 1.0, 2), (0.0, 2.0, 2)])
def test_drift_corrected_scan_has_its_measured_position(lab: Lab, off: float, scale: float, scans: int) -> None:
    scope = Scope(ExperimentLink(LabPort(lab), lab.name, source=SOURCE), frame=model.Frame.SAMPLE)
    wrong = model.Region((off * 1e-6, 0.0), (scale * 1e-6, scale * 1e-6), frame=model.Frame.SAMPLE)

    def first_elsewhere() -> None:
        lab.publish_scan(wrong if lab.begun_scans == 1 else REGION)

    lab.finish_scan = first_elsewhere  # type: ignore[method-assign]
    scope.scan(REGION)
    assert lab.begun_scans == scans


def test_a_spectrum_somewhere_else_is_taken_again(lab: Lab, scope: Scope) -> None:
    def moved() -> None:
        lab.position = model.ProbePosition((0.0, 0.0))
        lab.publish(lab.position)

    lab.at(20.0, moved)
    spectrum = scope.spectrum((2e-7, 3e-7), kind="IV")
    assert spectrum.position_m == (2e-7, 3e-7)
    assert lab.begun_scans == 2


def test_scan_of_a_person_of_the_same_frame_is_not_taken_for_the_own_one(lab: Lab, scope: Scope) -> None:
    # results m1
    publish = lab.publish

    def by_a_person(thing: object) -> None:
        if isinstance(thing, model.Scan):
            holder = "" if lab.begun_scans == 1 else lab.name
            publish(model.MeasurementConditions(thing.time_ns or 0, thing.filename, began_ns=1, holder=holder))
        publish(thing)

    lab.publish = by_a_person  # type: ignore[method-assign,assignment]
    scans = scope.scan(REGION, shape=(8, 8))
    assert lab.begun_scans == 2
    assert re.search("another measurement was taken", scans.interruptions[0])
