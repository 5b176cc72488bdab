"""The Drift Compensated Scheduler in an experiment file: its table, and the coordinates of components."""

from __future__ import annotations

from typing import Any

import pytest

from afspm.plugins.drift.frame.scheduler import DriftCompensatedScheduler

from .conftest import Write, errors, only_error

SCHEDULER = '[scheduler]\ncomponent = true\nclass = "{name}"\n'
MICROSCOPE = '[microscope]\ncomponent = true\nclass = "Simulator"\n'
BY_HAND = '[control]\nsolved_by_hand = ["thermal-drift", "device-malfunction"]\n'
RESCANNER = '[rescanner]\ncomponent = true\nclass = "{name}"\n'


def experiment(drift: str = "", name: str = "DriftCompensatedScheduler", rescanner: str = "Rescanner") -> str:
    table = f"drift = {{ {drift} }}\n" if drift else ""
    return MICROSCOPE + SCHEDULER.format(name=name) + table + RESCANNER.format(name=rescanner)


def launched(write: Write, text: str) -> dict[str, Any]:
    made = write(text, frame="")
    assert not errors(made)
    ports = iter(range(20_000, 20_100))
    found = made.launches(
        take_address=lambda: f"tcp://127.0.0.1:{next(ports)}", only=(), without=(), run_dir="run", state_dir="state"
    )
    return {start.launch.name: start.launch for start in found}


def test_settings_reach_the_scheduler_in_si_and_a_table_with_a_class_unchanged(write: Write) -> None:
    drift = 'correct_after = "2 h", tracker = { class = "paper", queue = 3 }, rescan = { tolerance = "20 nm" }'
    launch = launched(write, experiment(drift))["scheduler"]
    from afspm.transport.process.loading import load

    made = load(launch)
    assert isinstance(made, DriftCompensatedScheduler)
    assert made.drift.correct_after == 7200.0
    assert made.drift.rescan.tolerance == pytest.approx(20e-9)
    assert made.drift.tracker == {"class": "paper", "queue": 3}


@pytest.mark.parametrize(
    ("drift", "said"),
    [
        ('estimator = "sit"', "there is no estimator 'sit'"),
        ('estimator = "parts.NoSuch"', "no class NoSuch"),
        ('tracker = { class = "paper", queu = 3 }', "no setting 'queu'"),
        ('correct_afer = "2 h"', "drift.correct_afer is not a setting"),
        ('rescan = { tolerance = "20 s" }', "s can't be converted to m"),
        ('rescan = { rule = "papr" }', "not 'papr'"),
        ('compensate = { x = "x-rate" }', "drift.compensate.y is missing"),
        ('compensate = { x = "x-drift-rate-x", y = "x-rate" }', "needs the parameter 'x-rate'"),
        (
            'tracker = "paper", compensate = { x = "x-drift-rate-x", y = "x-drift-rate-y" }',
            "this tracker can't follow a controller that compensates",
        ),
        ("rescan = { tolerance = 0.0 }", "tolerance = 0.0 m is not above zero"),
    ],
)
def test_wrong_drift_settings_are_errors_of_the_check(write: Write, drift: str, said: str) -> None:
    assert said in only_error(write(experiment(drift), frame="")).what


def test_components_know_whether_places_are_in_sample_coordinates(write: Write) -> None:
    compensated = launched(write, experiment())
    assert compensated["rescanner"].sample_coordinates
    assert not compensated["microscope"].sample_coordinates
    plain = launched(write, MICROSCOPE + SCHEDULER.format(name="Scheduler") + RESCANNER.format(name="Metadata"))
    assert not plain["rescanner"].sample_coordinates


def test_components_of_a_scheduler_that_only_follows_drift_use_tip_coordinates(write: Write) -> None:
    followed = launched(write, experiment("correct = false"))
    assert not followed["rescanner"].sample_coordinates
    later = launched(write, experiment('correct_after = "2 h"'))
    assert later["rescanner"].sample_coordinates


def test_rescanner_without_a_drift_scheduler_is_a_finding(write: Write) -> None:
    found = errors(write(experiment(name="Scheduler"), frame=""))
    assert ["no component publishes" in one.what for one in found] == [True, True]  # wishes, and what comes of them


def test_drift_problem_needs_a_solver(write: Write) -> None:
    alone = MICROSCOPE + SCHEDULER.format(name="DriftCompensatedScheduler")
    assert "thermal-drift" in only_error(write(alone, frame="")).what
    assert not errors(write(alone + '[control]\nsolved_by_hand = ["thermal-drift", "device-malfunction"]\n', frame=""))


def test_published_names_of_drift_classes_are_known(write: Write) -> None:
    names = launched(
        write,
        experiment(
            name="afspm.components.drift.scheduler.DriftCompensatedScheduler",
            rescanner="afspm.components.drift.rescanner.DriftRescanner",
        ),
    )
    assert names["scheduler"].class_.endswith("drift.frame.scheduler.DriftCompensatedScheduler")
    assert names["rescanner"].class_.endswith("rescanner.Rescanner")


@pytest.mark.parametrize(("rescanner", "solved"), [(True, ("thermal-drift",)), (False, ())])
def test_scheduler_gets_the_solved_problems(write: Write, rescanner: bool, solved: tuple[str, ...]) -> None:
    text = experiment() if rescanner else experiment().replace(RESCANNER.format(name="Rescanner"), BY_HAND)
    assert launched(write, text)["scheduler"].solved == solved


@pytest.mark.parametrize(("solved", "at_start"), [(("thermal-drift",), "up-down"), ((), "nothing")])
def test_without_a_rescanner_the_first_scan_is_taken_once(solved: tuple[str, ...], at_start: str) -> None:
    assert DriftCompensatedScheduler().drift.beside(solved).at_start == at_start
