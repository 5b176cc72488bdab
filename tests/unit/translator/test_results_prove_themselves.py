"""What is published as complete is what it stands for: tip, feedback and settings in force, over kills."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from afspm.model import (
    ActByHand,
    ControlRequest,
    ControlResponse,
    Feedback,
    MeasurementConditions,
    PanelAct,
    Parameter,
    Region,
    ScopeState,
    Spectrum,
    TipStatus,
    names,
)
from afspm.translator import judge as judging
from afspm.translator.judge import RULES, Claim, Stated, Witness, judge

OK, NOT_FREE = ControlResponse.SUCCESS, ControlResponse.NOT_FREE
ACTION, PARAM = ControlRequest.ACTION, ControlRequest.PARAM
WITH_TIP = {"x-engaged": {"vendor": "Engaged", "type": "bool", "read_only": True}}
BIAS = Parameter("tip-bias-voltage", "0.2", "V")


@pytest.fixture
def bench(make_bench: Any) -> Any:
    made = make_bench({"parameters": WITH_TIP})
    made.look()
    made.heard()
    made.beside.clear()
    return made


def acts(bench: Any) -> list[PanelAct]:
    bench.heard()
    return [one.act for one in bench.beside if isinstance(one, ActByHand)]


def scan_it(bench: Any, scan: Any, name: str, during: dict[str, Any] | None = None) -> list[str]:
    """Take a scan with values changed meanwhile, and return what is published from its begin on."""
    bench.heard()
    assert bench.ask(ACTION, names.START_SCAN, f"series/1-2/{name}").code == OK
    bench.microscope.values |= during or {}
    bench.microscope.files[name] = [scan()]
    bench.microscope.state = ScopeState.FREE
    bench.look()
    return list(bench.heard())


def curve(bench: Any, name: str) -> None:
    bench.microscope.files[name] = [Spectrum((0.0, 0.0), "IV", ("V", "I"), ("V", "A"), np.ones((4, 2)))]
    bench.microscope.state = ScopeState.FREE


def test_a_result_has_its_begin_its_holder_and_its_settings(bench: Any, scan: Any) -> None:
    assert bench.ask(PARAM, BIAS).code == OK
    assert scan_it(bench, scan, "1")[-2:] == ["Scan2d", "FREE"]
    (found,) = [one for one in bench.beside if isinstance(one, MeasurementConditions)]
    assert (found.holder, found.began_ns is not None) == ("series", True)
    assert [(one.name, float(one.value or "")) for one in (*found.begin_values, *found.end_values)] == [
        ("tip-bias-voltage", 0.2)
    ] * 2


def test_a_result_has_the_settings_of_its_caption_at_both_ends(bench: Any, scan: Any) -> None:  # spectra F10
    assert scan_it(bench, scan, "1", during={"Bias": 300.0})[-2:] == ["Scan2d", "FREE"]
    (found,) = [one for one in bench.beside if isinstance(one, MeasurementConditions)]
    assert not found.begin_values, "the run has set nothing"
    bias = next(one for one in found.in_force if one.name == names.TIP_BIAS_VOLTAGE)
    assert bias.columns == {"tip-bias-voltage [V]": 0.1, "tip-bias-voltage.end [V]": 0.3}
    assert names.SCAN_SPEED in {one.name for one in found.in_force}


@pytest.mark.parametrize("of", ["sample", "tip", None])
def test_a_result_has_the_reference_of_its_bias_where_it_is_known(make_bench: Any, scan: Any, of: str | None) -> None:
    bench = make_bench({"bias_reference": of})
    assert scan_it(bench, scan, "1")[-2:] == ["Scan2d", "FREE"]
    (found,) = [one for one in bench.beside if isinstance(one, MeasurementConditions)]
    assert [one.columns for one in found.in_force if one.name == "bias-reference"] == (
        [{"bias-reference": of}] if of else []
    )


def test_alias_never_reaches_a_controller_without_its_scheduler(bench: Any) -> None:
    for value in ("1", None):
        answer = bench.ask(PARAM, Parameter("sample-bias", value, "V"))
        assert (answer.code, "name tip-bias-voltage here" in answer.reason) == (8, True)


def test_a_setting_that_cannot_be_read_is_left_out_of_its_caption(make_bench: Any, scan: Any) -> None:
    bench = make_bench({"parameters": {"x-sensitivity": {"vendor": "Lock", "unit": "m/V"}}})
    bench.microscope.values["Lock"] = 1e-7
    bench.look()
    assert scan_it(bench, scan, "1", during={"Lock": math.nan})[-2:] == ["Scan2d", "FREE"]
    (found,) = [one for one in bench.beside if isinstance(one, MeasurementConditions)]
    assert "x-sensitivity" in {one.name for one in found.begin_in_force}
    assert {one.name for one in found.end_in_force} == {one.name for one in found.begin_in_force} - {"x-sensitivity"}


# results C1: 78 of 78 curves without feedback were complete
@pytest.mark.parametrize("off_at", ["begin", "during"])
def test_series_of_curves_stops_once_the_feedback_is_off(bench: Any, off_at: str) -> None:
    assert bench.ask(ACTION, names.START_SPEC).code == OK
    bench.microscope.values["Loop"] = False
    curve(bench, "a")
    bench.look()
    assert "FREE" not in bench.heard(), "the controller may hold the feedback still"
    for _ in range(7):
        bench.look()
    assert bench.heard() == ["INTERRUPTED", "FREE", "ZCtrlParameters"]
    assert acts(bench) == [PanelAct.FEEDBACK_OFF]
    assert bench.ask(ACTION, names.START_SPEC).code == NOT_FREE


def test_curve_is_complete_if_the_controller_gives_the_feedback_back_late(bench: Any) -> None:
    assert bench.ask(ACTION, names.START_SPEC).code == OK
    bench.microscope.values["Loop"] = False
    curve(bench, "a")
    bench.look()
    bench.look(0.2)
    assert "FREE" not in bench.heard()
    bench.microscope.values["Loop"] = True
    bench.look()
    assert bench.heard()[-2:] == ["Spec1d", "FREE"]
    assert acts(bench) == []


@pytest.mark.parametrize("held", [False, True])
def test_value_that_a_spectrum_sweeps_is_no_act_by_hand_in_a_series(bench: Any, held: bool) -> None:
    for name in ("a", "b", "c"):
        assert bench.ask(ACTION, names.START_SPEC).code == OK
        bench.microscope.values |= {"Bias": -700.0, "PX": 0.3, "Loop": not held}
        bench.look(2.0)  # reads all settings in the spectrum
        curve(bench, name)
        bench.microscope.values |= {"Bias": 100.0, "PX": 0.0, "Loop": True}
        bench.look(0.01)
        assert bench.heard()[-1] == "FREE"
    bench.look(2.0)
    assert acts(bench) == []


# results M1
@pytest.mark.parametrize("name", ["Loop", "Engaged"])
def test_scan_is_not_complete_if_the_tip_was_changed_while_no_translator_ran(bench: Any, scan: Any, name: str) -> None:
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    bench.microscope.values[name] = False
    bench.start()
    bench.look()
    bench.heard()
    bench.microscope.files["a"] = [scan()]
    bench.microscope.state = ScopeState.FREE
    bench.look()
    assert bench.heard()[-2:] == ["INTERRUPTED", "FREE"]
    bench.look()
    act = {"Loop": PanelAct.FEEDBACK_OFF, "Engaged": PanelAct.WITHDRAW}[name]
    assert acts(bench) == [act]
    assert bench.ask(ACTION, names.START_SCAN).code == NOT_FREE


# results C3
@pytest.mark.parametrize("when", ["before the start", "in the scan"])
def test_value_set_for_a_scan_and_changed_by_a_person_is_measured_again_once(bench: Any, scan: Any, when: str) -> None:
    for n in range(2):
        assert bench.ask(PARAM, BIAS).code == OK
        changed = {"Bias": 1000.0 + n}
        if when == "before the start":
            bench.microscope.values |= changed
        assert scan_it(bench, scan, str(n), changed)[-2:] == ["INTERRUPTED", "FREE"]
    assert PanelAct.CONTRADICTION in acts(bench)
    bench.heard()
    # not set again: it stays the person's
    assert scan_it(bench, scan, "9")[-2:] == ["Scan2d", "FREE"]


def test_value_that_the_run_changes_in_its_own_scan_is_no_contradiction(bench: Any, scan: Any) -> None:
    assert bench.ask(PARAM, BIAS).code == OK
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    assert bench.ask(PARAM, Parameter("tip-bias-voltage", "0.4", "V")).code == OK
    bench.microscope.files["a"] = [scan()]
    bench.microscope.state = ScopeState.FREE
    bench.look()
    assert bench.heard()[-2:] == ["Scan2d", "FREE"]


def test_person_who_works_at_constant_height_all_night_is_not_stopped(make_bench: Any, scan: Any, caplog: Any) -> None:
    bench = make_bench({"parameters": WITH_TIP})
    (bench.folder / "translator.json").unlink(missing_ok=True)
    bench.microscope.values["Loop"] = False
    bench.start()
    for n in range(3):
        assert scan_it(bench, scan, str(n))[-2:] == ["Scan2d", "FREE"]
    assert acts(bench) == []
    assert "off since before this run" in caplog.text


def test_feedback_off_before_a_run_forbids_a_start_where_the_tip_is_not_shown(make_bench: Any) -> None:
    bench = make_bench()
    (bench.folder / "translator.json").unlink(missing_ok=True)
    bench.microscope.values["Loop"] = False
    bench.start()
    bench.look()
    refused = bench.ask(ACTION, names.START_SCAN)
    assert refused.code == NOT_FREE
    assert "off since before this run" in refused.reason
    assert bench.ask(ACTION, names.FEEDBACK_MAY_BE_OFF).code == OK
    assert bench.ask(ACTION, names.START_SCAN).code == OK


def test_person_who_begins_a_run_with_feedback_off_says_so_once_for_each_start(make_bench: Any, caplog: Any) -> None:
    bench = make_bench()
    (bench.folder / "translator.json").unlink(missing_ok=True)
    bench.microscope.values["Loop"] = False
    bench.start(feedback_off="1")
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    assert bench.ask(ACTION, names.STOP_SCAN).code == OK
    bench.look()
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=True)).code == OK
    bench.start(feedback_off="1")  # restarted: the run wishes it on since, and the text is of its start
    bench.microscope.values["Loop"] = False
    bench.look()
    assert bench.ask(ACTION, names.START_SCAN).code == NOT_FREE
    bench.start(feedback_off="2")  # resumed
    bench.look()
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    assert caplog.text.count("off by intention: so says the person") == 2


@pytest.mark.parametrize("says", [True, False])
def test_action_that_leaves_the_feedback_off_says_so(make_bench: Any, scan: Any, says: bool) -> None:
    lift = {"command": "lift"} | ({"switches_feedback": True} if says else {})
    bench = make_bench({"parameters": WITH_TIP, "actions": {"x-lift": lift}})
    bench.look()
    bench.heard()
    assert bench.ask(ACTION, "x-lift").code == OK
    bench.microscope.values["Loop"] = False
    for _ in range(8):
        bench.look()
    found = [one for one in bench.beside if isinstance(one, ActByHand)]
    bench.heard()
    if says:
        assert scan_it(bench, scan, "1")[-2:] == ["Scan2d", "FREE"]
        assert found == []
    else:
        assert "perhaps by x-lift, which does not say `switches_feedback`" in bench.ask(ACTION, "start-scan").reason
        assert acts(bench) == [PanelAct.FEEDBACK_OFF]


def test_scan_at_constant_height_with_the_feedback_found_on_is_not_complete(bench: Any, scan: Any) -> None:
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=False)).code == OK
    assert scan_it(bench, scan, "1", {"Loop": True})[-2:] == ["INTERRUPTED", "FREE"]
    assert acts(bench) == []


S = 1_000_000_000


OF = Region((0.0, 0.0), (1e-7, 1e-7), 0.5)
CLAIM = Claim(100 * S, "series", TipStatus(True, True), {"bias": 1.0}, frame=OF, shape=(32, 64))
AWAY = Region((2e-10, 0.0), (1e-7, 1e-7), 0.5)
TURNED = Region((0.0, 0.0), (1e-7, 1e-7), 0.502)
NEAR = Region((5e-11, 0.0), (1e-7, 1e-7), 0.5 + math.tau)


@pytest.mark.parametrize("without", [False, True])
@pytest.mark.parametrize(
    ("rule", "stated", "witness"),
    [
        ("one start", Stated((10 * S, 40 * S)), Witness()),
        ("new start", Stated((10 * S,), earlier={10 * S: 20 * S}), Witness()),
        ("end after start", Stated((10 * S,), (5 * S,)), Witness()),
        ("one picture", Stated((10 * S,), (30 * S,), pictures=2), Witness()),
        ("own start", Stated((10 * S,), (30 * S,), at_most_ns=6 * S), Witness()),
        ("own frame", Stated(frame=AWAY, shape=(32, 64)), Witness()),
        ("own frame", Stated(frame=TURNED, shape=(32, 64)), Witness()),
        ("own frame", Stated(frame=OF, shape=(64, 64)), Witness()),
        ("undisturbed", Stated(disturbed="its frame was changed"), Witness()),
        ("tip at the sample", Stated(), Witness(TipStatus(False, True))),
        ("values in force", Stated(), Witness(TipStatus(True, True), {"bias": "bias was 2 V at its end"})),
        ("", Stated((10 * S, 10 * S), (30 * S,), {5 * S: 20 * S}, NEAR, (32, 64), at_most_ns=19 * S), Witness()),
        ("", Stated((10 * S, 10 * S), (10 * S,), {10 * S: 99 * S}), Witness()),  # short scans of one second
    ],
)
def test_result_that_does_not_prove_itself_is_none(
    rule: str, stated: Stated, witness: Witness, monkeypatch: pytest.MonkeyPatch, *, without: bool
) -> None:
    assert rule in {"", *RULES}
    if without:  # no other rule would find it
        monkeypatch.setattr(judging, "RULES", {name: one for name, one in RULES.items() if name != rule})
    assert judge(Claim.of(json.loads(json.dumps(CLAIM.kept()))), witness, stated).rule == ("" if without else rule)
