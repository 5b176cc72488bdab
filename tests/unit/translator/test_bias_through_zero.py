"""A bias that changes its sign at the sample: set at once, with z held for it, or refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from tests.unit.translator.test_held_z import PARAM, STM, AtOnce, act, get, number, until_free

from afspm.basics.errors import InvalidValue, Refused
from afspm.model import ActByHand, ControlResponse, Parameter, names
from afspm.translator.driver_base import ControllerLost

BIAS, ON = names.TIP_BIAS_VOLTAGE, names.FEEDBACK_ON


class Written(AtOnce):
    """A simulated microscope that keeps what is set, and may refuse or lose it."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.sets: list[tuple[str, Any]] = []
        self.fails: dict[tuple[str, Any], Exception] = {}

    def put_in_force(self, values: Any) -> None:
        for one in values.items():
            if (error := self.fails.pop(one, None)) is not None:
                raise error
            self.sets.append(one)
        super().put_in_force(values)


def microscope(bench: Any, tmp_path: Path, how: str, **more: Any) -> Any:
    (tmp_path / "simulated").mkdir()
    return type(bench)(tmp_path / "simulated", {**STM, "bias_through_zero": how, **more}, Written)


def set_bias(scope: Any, volts: float) -> Any:
    return scope.ask(PARAM, Parameter(BIAS, str(volts), "V"))


def sets(scope: Any) -> list[tuple[str, Any]]:
    return [one for one in scope.microscope.sets if one[0] in (BIAS, ON)]


def test_z_is_held_while_the_bias_passes_zero_and_the_feedback_is_on_again(bench: Any, tmp_path: Path) -> None:
    scope = microscope(bench, tmp_path, "hold")
    z_m = number(scope, names.TIP_Z)
    assert set_bias(scope, -0.5).ok
    assert sets(scope) == [(ON, False), (BIAS, -0.5), (ON, True)]
    assert (get(scope, ON), number(scope, BIAS)) == ("true", -0.5)
    assert scope.translator.observer.panel.feedback.wished is True
    assert get(scope, names.Z_IS_HELD) == "false"
    scope.look()
    scope.heard()
    assert not [one for one in scope.beside if isinstance(one, ActByHand)]
    assert number(scope, names.TIP_Z) == pytest.approx(z_m, abs=1e-10)
    assert act(scope, names.START_SCAN).ok


@pytest.mark.parametrize(("how", "volts"), [("hold", 0.5), ("jump", -0.5), ("hold", 0.0)])
def test_all_else_is_set_at_once(bench: Any, tmp_path: Path, how: str, volts: float) -> None:
    scope = microscope(bench, tmp_path, how)
    assert set_bias(scope, volts).ok
    assert sets(scope) == [(BIAS, volts)]


def test_held_or_withdrawn_tip_and_a_feedback_on_no_current_need_no_hold(bench: Any, tmp_path: Path) -> None:
    scope = microscope(bench, tmp_path, "hold")
    assert act(scope, names.HOLD_Z).ok
    assert set_bias(scope, -0.5).ok
    assert [one for one in sets(scope) if one[0] == BIAS] == [(BIAS, -0.5)]
    assert get(scope, names.Z_IS_HELD) == "true"


def test_refused_where_the_file_says_so_and_in_a_measurement(bench: Any, tmp_path: Path) -> None:
    scope = microscope(bench, tmp_path, "refuse")
    refused = set_bias(scope, -0.5)
    assert refused.code == ControlResponse.PARAM_ERROR
    assert 'withdraw the tip first, or write bias_through_zero = "jump"' in refused.reason
    assert sets(scope) == []


def test_refused_bias_leaves_the_feedback_on_and_the_former_bias(bench: Any, tmp_path: Path) -> None:
    scope = microscope(bench, tmp_path, "hold")
    scope.microscope.fails[BIAS, -0.5] = Refused(ControlResponse.PARAM_ERROR, "not here")
    assert "not here" in set_bias(scope, -0.5).reason
    assert (get(scope, ON), number(scope, BIAS)) == ("true", 0.1)
    assert act(scope, names.START_SCAN).ok


def test_tip_is_withdrawn_where_the_feedback_stays_off(bench: Any, tmp_path: Path) -> None:
    scope = microscope(bench, tmp_path, "hold")
    scope.microscope.fails[ON, True] = InvalidValue("no feedback today")
    refused = set_bias(scope, -0.5)
    assert "the tip withdrawn" in refused.reason
    until_free(scope)
    assert get(scope, names.ENGAGED) == "false"


def test_way_back_follows_a_lost_controller_and_no_measurement_is_refused_for_it(bench: Any, tmp_path: Path) -> None:
    scope = microscope(bench, tmp_path, "hold")
    scope.microscope.fails[BIAS, -0.5] = ControllerLost("the cable")
    assert not set_bias(scope, -0.5).ok
    for _ in range(20):
        scope.look(1.0)
    until_free(scope)
    assert (get(scope, ON), number(scope, BIAS)) == ("true", 0.1)
    assert act(scope, names.START_SCAN).ok


def test_tip_that_is_lifted_as_the_feedback_goes_off_is_at_the_setpoint_again(bench: Any, tmp_path: Path) -> None:
    scope = microscope(bench, tmp_path, "hold")
    z_m = scope.microscope.in_force([names.TIP_Z])[names.TIP_Z]
    shown = scope.microscope.in_force

    def in_force(wanted: Any) -> dict[str, Any]:
        found = dict(shown(wanted))
        is_off = (ON, False) in scope.microscope.sets and (ON, True) not in scope.microscope.sets
        return found | ({names.TIP_Z: z_m + 1e-9} if is_off and names.TIP_Z in found else {})

    scope.microscope.in_force = in_force
    assert "switch a tip lift of the controller off" in set_bias(scope, -0.5).reason
    assert sets(scope) == [(ON, False), (ON, True)]
    assert (get(scope, ON), number(scope, BIAS)) == ("true", 0.1)
    assert act(scope, names.START_SCAN).ok


def test_controller_that_shows_its_ramp_gets_no_feedback_on_the_way(bench: Any, tmp_path: Path) -> None:
    scope = microscope(bench, tmp_path, "hold")
    sets_it = scope.microscope.put_in_force
    scope.microscope.put_in_force = lambda values: sets_it({BIAS: 0.02} if BIAS in values else values)
    assert not set_bias(scope, -0.5).ok
    assert get(scope, ON) == "false"
    until_free(scope)
    assert get(scope, names.ENGAGED) == "false"


def test_hold_of_the_run_that_a_person_has_ended_keeps_its_way_back(bench: Any, tmp_path: Path) -> None:
    scope = microscope(bench, tmp_path, "hold")
    assert act(scope, names.HOLD_Z).ok
    assert scope.ask(PARAM, Parameter(BIAS, "0.01", "V")).ok
    scope.microscope.put_in_force({ON: True})
    assert not set_bias(scope, -0.5).ok
    scope.look()
    assert number(scope, BIAS) == 0.1
