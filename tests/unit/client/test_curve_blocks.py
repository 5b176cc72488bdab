"""Settings of curves are in force at each curve, and set back at the end, whatever is killed or changed meanwhile."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from client_lab import Kill9, Lab, LabPort, scope_of

from afspm.basics.errors import InvalidValue
from afspm.client.scope import Scope
from afspm.model import names
from afspm.scheduler.control.arbitration import ArbitrationEvent

SETTINGS = {"sweep": ("-500 mV", "500 mV"), "points": 201}
WANTED = ("-0.5", "0.5", "201")
BEFORE = ("-1.5", "1.5", "256")


class CurveLab(Lab):
    """Notes the settings in force when each curve ends; a height has numbers of points of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.values |= dict(zip((*names.SPEC_ENDS, names.SPEC_POINTS), BEFORE, strict=True)) | {"x-spec-kind": "IV"}
        self.measured: list[tuple[str, str, str]] = []

    @property
    def in_force(self) -> tuple[str, str, str]:
        return self.values["x-spec-from"], self.values["x-spec-to"], self.values["x-spec-points"]

    def finish_spectrum(self) -> None:
        self.measured.append(self.in_force)
        super().finish_spectrum()


def two_curves(scope: Scope) -> None:
    with scope.curves(SETTINGS, kind="IV"):
        for number in (1, 2):
            scope.spectrum((number * 1e-7, 0.0), kind="IV", key=f"curve-{number}")


def test_one_spectrum_may_have_settings_of_its_own() -> None:
    lab = CurveLab()
    scope = scope_of(lab)
    taken = scope.spectrum((1e-7, 0.0), kind="IV", sweep=("-500 mV", "500 mV"), points=201)
    scope.spectrum((1e-7, 0.0), kind="IV")
    assert taken.kind == "IV"
    assert lab.measured == [WANTED, BEFORE]
    assert lab.control.holder is None


def test_settings_are_set_again_after_another_has_changed_them() -> None:
    lab = CurveLab()
    with (scope := scope_of(lab)).curves(SETTINGS, kind="IV"):
        scope.spectrum((1e-7, 0.0))
        lab.values["x-spec-to"] = "10"
        scope.spectrum((2e-7, 0.0))
    assert lab.measured == [WANTED, WANTED]
    assert lab.in_force == BEFORE


@pytest.mark.parametrize("is_late", [True, False])
def test_killed_at_any_step_each_curve_is_taken_once_and_the_settings_are_set_back(*, is_late: bool) -> None:
    for deadly_call in range(1, 1000):
        lab = CurveLab()
        with TemporaryDirectory() as folder:
            try:
                two_curves(scope_of(lab, Path(folder), 0, LabPort(lab, deadly_call, is_late=is_late)))
                break  # survived: all steps were tried
            except Kill9:
                pass
            lab.does(ArbitrationEvent.DEAD, lab.name)
            lab.restart_component()
            two_curves(scope_of(lab, Path(folder), 1))
        assert lab.measured == [WANTED, WANTED], f"killed at call {deadly_call}"
        assert lab.in_force == BEFORE, f"killed at call {deadly_call}"
    assert deadly_call > 30


def test_settings_are_set_back_after_an_error_in_the_block() -> None:
    lab = CurveLab()
    scope = scope_of(lab)

    def fail_in_the_block() -> None:
        with scope.curves(SETTINGS):
            scope.spectrum((1e-7, 0.0))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_in_the_block()
    assert lab.in_force == BEFORE


def test_wrong_request_sends_nothing() -> None:
    lab = CurveLab()
    with pytest.raises(InvalidValue, match="pionts"):
        scope_of(lab).spectrum(kind="IV", pionts=3)  # type: ignore[call-arg]
    assert not lab.executed


def test_block_and_sweep_with_one_key_are_both_set_back(tmp_path: Path) -> None:
    lab = CurveLab()
    scope = scope_of(lab, tmp_path)
    with scope.curves(SETTINGS), scope.sweep({"x-spec-to": ["0.6 V"]}, measure="spectrum", key="a") as points:
        list(points)
    assert lab.measured == [("-0.5", "0.6", "201")]
    assert lab.in_force == BEFORE


def test_spectrum_of_another_kind_in_a_block_is_refused() -> None:
    lab = CurveLab()
    scope = scope_of(lab)
    with scope.curves(SETTINGS):
        assert scope.spectrum((1e-7, 0.0)).kind == "IV", "the kind in force at its begin"
        with pytest.raises(InvalidValue, match="settings of IV"):
            scope.spectrum((1e-7, 0.0), kind="force")
    assert lab.in_force == BEFORE


def test_block_in_a_sweep_is_refused() -> None:
    lab = CurveLab()
    scope = scope_of(lab)
    with scope.sweep({"x-spec-to": ["0.6 V"]}, measure="spectrum"), pytest.raises(InvalidValue, match="before a sweep"):
        scope.spectrum((1e-7, 0.0), points=20)
    assert not lab.measured


# physics P1, settings S4
def test_others_may_measure_between_two_curves_of_a_block() -> None:
    lab = CurveLab()
    with (scope := scope_of(lab)).curves(SETTINGS):
        scope.spectrum((1e-7, 0.0))
        assert lab.control.holder is None
