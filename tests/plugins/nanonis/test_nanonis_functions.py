"""Functions of Nanonis in an experiment file: commands of actions and parameters, judged by the limits."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from tests.plugins.nanonis.nanonis_bench import Bench
from tests.plugins.vendor_bench import ready

from afspm.basics import ConfigError, InvalidValue
from afspm.experiment import load
from afspm.model import ControlResponse, ScopeState, names
from afspm.plugins import nanonis
from afspm.plugins.nanonis import Nanonis
from afspm.plugins.nanonis.experiment_functions import FunctionCall, ValueFunctions

Make = Callable[..., Bench]
FRAME = '[scheduler]\ncomponent = true\nclass = "Scheduler"\n[microscope]\ncomponent = true\nclass = "Nanonis"\n'


# --- over the wire ---


def test_documented_function_is_called_by_an_action(bench: Make) -> None:
    # spectra F11: 77 of 688 functions were reachable
    commands = {
        "x-lock-in-on": "LockIn.ModOnOffSet 1 1",
        "x-log-channels": "TCPLog.ChsSet [0,14]",
        "x-cloud": "Pattern.CloudSet 0 2 [1e-9,2e-9] [0,-1e-9]",
        "x-name": "UserOut.CalcSignalNameSet 2 'my signal'",
        "x-sweep": "BiasSpectr.LimitsSet -0.3 0.3",
        "x-output": "UserOut.ValSet 1 0.5",
        "x-no-module": "Laser.OnOffSet 1",
    }
    made = bench()
    peer = made.start(actions={name: {"command": command} for name, command in commands.items()})
    peer.until(ScopeState.FREE)
    for name in [*commands][:-1]:
        assert peer.act(name).ok, name
    registers = made.emulator.software.core.registers
    assert registers.get("LockIn.ModOnOff", (1,)) == (1,)
    assert registers.get("Pattern.Cloud")[1] == [pytest.approx(1e-9), pytest.approx(2e-9)]
    assert registers.get("UserOut.CalcSignalName", (2,)) == ("my signal",)
    call = made.emulator.software.functions.call
    assert call("BiasSpectr.LimitsGet", []) == (pytest.approx(-0.3), pytest.approx(0.3))
    response = peer.act("x-no-module")
    assert response.code == ControlResponse.ACTION_ERROR
    assert "Laser.OnOffSet" in response.reason
    assert "Module not available" in response.reason


def test_parameter_of_an_experiment_file_is_one_value_of_a_pair_of_functions(bench: Make) -> None:
    rows: dict[str, dict[str, object]] = {
        "x-tip-lift": {"vendor": "ZCtrl.TipLift", "unit": "m"},
        "x-harmonic": {"vendor": "LockIn.ModHarmonic 1", "type": "int"},
        "x-settling": {"vendor": "ZSpectr.Timing #2", "unit": "s"},
        "x-cutoff": {"vendor": "LockIn.DemodLPFilter 2 #2", "unit": "Hz"},
        "x-offset-back": {"vendor": "BiasSpectr.ZOffRevert", "type": "bool"},
        "x-slew": {"vendor": "BiasSpectr.Timing #5", "unit": "s"},
        "x-bias-signal": {"vendor": "Signals.Val 24 1", "unit": "V", "read_only": True},
    }
    made = bench()
    peer = made.start(parameters=rows)
    peer.until(ScopeState.FREE)
    registers = made.emulator.software.core.registers
    assert peer.set("x-tip-lift", "2", "nm").ok
    assert registers.get("ZCtrl.TipLift") == (pytest.approx(2e-9),)
    assert peer.set("x-harmonic", "2").ok
    assert registers.get("LockIn.ModHarmonic", (1,)) == (2,)
    assert registers.get("LockIn.ModHarmonic", (2,)) == (), "the other modulator keeps its harmonic"
    assert peer.set("x-settling", "10", "ms").ok
    assert registers.get("ZSpectr.Timing")[:2] == pytest.approx((0.05, 0.01), rel=1e-6)
    made.at_panel(lambda emulator: emulator.software.functions.call("LockIn.DemodLPFilterSet", [2, 4, 50.0]))
    assert peer.set("x-cutoff", "100", "Hz").ok
    assert registers.get("LockIn.DemodLPFilter", (2,)) == (4, 100.0), "the order is marked as unchanged"
    for wanted in ("true", "false"):
        assert peer.set("x-offset-back", wanted).ok
        assert peer.get("x-offset-back") == wanted
    assert float(peer.get("x-slew")) == pytest.approx(0.002), "an infinite slew rate beside it is no bad answer"
    assert abs(float(peer.get("x-bias-signal"))) <= 10.0


def test_action_that_the_check_refuses_is_refused_in_a_run(bench: Make) -> None:
    made = bench()
    commands = {"x-wrong": "Bias.Set 1 2", "x-home": "ZCtrl.Home", "x-far": "Bias.Set 11"}
    peer = made.start(actions={name: {"command": command} for name, command in commands.items()})
    ready(peer)
    for name, what in (("x-wrong", "Bias.Set takes float32, not 1 2"), ("x-home", "it moves z"), ("x-far", "11 V is")):
        response = peer.act(name)
        assert response.code == ControlResponse.ACTION_ERROR
        assert what in response.reason
    assert not any("ZCtrl.Home" in asked for asked in made.emulator.asked.values())


def test_setpoint_of_a_command_stays_within_the_preamplifiers_range(bench: Make) -> None:
    made = bench()
    peer = made.start(actions={"x-hard": {"command": "ZCtrl.SetpntSet 50e-9"}})
    ready(peer)
    response = peer.act("x-hard")
    assert response.code == ControlResponse.PARAM_ERROR
    assert "the preamplifier's range" in response.reason


# --- at the check of the file ---


def errors(tmp_path: Path, text: str) -> list[str]:
    path = tmp_path / "experiment.toml"
    path.write_text(FRAME + text)
    return [f"{one.what} ({one.hint})" for one in load(path).check() if one.is_error]


@pytest.mark.parametrize(
    ("command", "what"),
    [
        (
            "LockIn.ModOnOf 1 1",
            "afspm's table of Nanonis functions has no 'LockIn.ModOnOf' (perhaps LockIn.ModOnOffSet",
        ),
        ("", "has no ''"),
        ("Bias.Set '1", "No closing quotation"),
        ("LockIn.ModOnOffSet 1", "LockIn.ModOnOffSet takes int32 uint32, not 1"),
        ("LockIn.ModOnOffSet 1 on", "takes int32 uint32, not 1 on"),
        ("LockIn.ModOnOffSet 1 -1", "-1 can't be sent as uint32"),
        ("TCPLog.ChsSet 0", "takes [int32,...], not 0"),
        ("Pattern.CloudSet 0 3 [1e-9] [0]", "it has 1 items, not 3"),
        ("AutoApproach.OnOffSet 1", "it brings the tip to the sample: use x-approach"),
        ("ZCtrl.OnOffSet 0", "write set = { x-feedback-on = … }"),
        ("ZCtrl.ZPosSet 1e-9", "it moves z, which no limit bounds: declare a parameter"),
        ("ZCtrl.Withdraw 0 -1", "use x-retract"),
        ("MProbeZCtrl.Home 1", "it moves another probe"),
        ("BiasSpectr.TimingSet 0.05 1e-9 0.005 1 0.002 0.001 0.005 0.2", "its z offset moves the tip"),
        ("Bias.Pulse 0 0.1 3 0 1", "write 2, absolute, as the last argument"),
        ("GenSwp.Start 0 1 a 0 0", "write withdrawn = true into the action, or withdrawn = false"),
        ("Scan.BufferSet [0,14] 256 0", "scan-resolution-y: 0 px is outside"),
        ("BiasSpectr.LimitsSet -12 0", "tip-bias-voltage: -12 V is outside -10 V to 10 V"),
        ("BiasSpectr.PropsSet 0 0 0 256 nan 0 0", ""),
        ("BiasSpectr.TimingSet 0.05 0 0.005 inf 0.002 0.001 0.005 0.2", ""),
        ("AutoApproach.OnOffSet 0", ""),
        ("MProbeZCtrl.ZPosGet 1", ""),
        ("ZCtrl.WithdrawRateSet 1e-7", ""),
        ("Scan.Action 2 0", ""),
    ],
)
def test_command_is_checked_before_a_run(tmp_path: Path, command: str, what: str) -> None:
    found = errors(tmp_path, f'actions.x-own = {{ command = "{command}" }}\n')
    assert len(found) == bool(what), found
    assert all("[microscope] actions.x-own: " in one and what in one for one in found)


@pytest.mark.parametrize("withdrawn", ["true", "false"])
def test_sweep_of_a_signal_chosen_in_nanonis_needs_a_word_on_the_tip(tmp_path: Path, withdrawn: str) -> None:
    action = f'actions.x-own = {{ command = "GenSwp.Start 0 1 a 0 0", withdrawn = {withdrawn} }}\n'
    assert errors(tmp_path, action) == []


@pytest.mark.parametrize(
    ("row", "what"),
    [
        ({"vendor": "LockIn.ModAmp"}, "LockIn.ModAmpGet takes int32, not none"),
        ({"vendor": "ZSpectr.Range #3"}, "returns float32 float32, without a value #3"),
        ({"vendor": "ZSpectr.Range #b"}, "without a value #b"),
        ({"vendor": "Signals.Names"}, "which is no parameter"),
        ({"vendor": "LockIn.DemodHarmonic 1"}, "write type = 'int'"),
        ({"vendor": "Current."}, "write read_only = true"),
        ({"vendor": "Bias."}, "Bias.Set sets tip-bias-voltage: use that parameter"),
        ({"vendor": "BiasSpectr.Limits #2"}, "sets tip-bias-voltage"),
        ({"vendor": "ZCtrl.OnOff", "type": "bool"}, "write set = { x-feedback-on = … }"),
        ({"vendor": "AutoApproach.OnOff", "type": "int"}, "it brings the tip to the sample"),
        ({"vendor": "KelvinCtrl.CtrlOnOff", "type": "bool"}, "use it in an action"),
    ],
)
def test_parameter_is_checked_before_a_run(row: dict[str, Any], what: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Nanonis.parameter_table({"x-own": row})
    assert what in str(caught.value)
    assert caught.value.where == "the experiment file, parameters.x-own"


def test_recipes_of_the_readme_are_accepted() -> None:
    page = Path(str(resources.files(nanonis) / "README.md")).read_text(encoding="utf-8")
    blocks = [
        tomllib.loads(block)["microscope"] for block in re.findall(r"^```toml\n(.*?)^```", page, re.DOTALL | re.M)
    ]
    actions = {name: action for block in blocks for name, action in block.get("actions", {}).items()}
    rows = {name: row for block in blocks for name, row in block.get("parameters", {}).items() if name[:2] == "x-"}
    assert len(actions) > 7
    assert len(rows) > 5
    table = Nanonis.parameter_table(rows)
    assert Nanonis.values_commanded(actions.pop("x-narrow-sweep"), table) == [
        (names.TIP_BIAS_VOLTAGE, -0.3),
        (names.TIP_BIAS_VOLTAGE, 0.3),
    ]
    assert all(Nanonis.values_commanded(action, table) == [] for action in actions.values())


def test_key_of_a_parameter_and_texts_of_a_command_are_read() -> None:
    with pytest.raises(InvalidValue):
        ValueFunctions.of("PLL.FreqShift")
    assert ValueFunctions.of("PLL.FreqShift 1").keys == (1,)
    assert FunctionCall.of("Script.Autosave 1 2 1 a 'b c'").arguments == (1, 2, 1, "a", "b c")


# --- limits ---


@pytest.mark.parametrize(
    ("command", "what"),
    [
        ("Bias.Set 2.5", "tip-bias-voltage = 2.5 V is above the highest allowed, 2 V"),
        ("BiasSpectr.LimitsSet -3 0.5", "tip-bias-voltage = -3 V is below"),
        ("BiasSpectr.MLSValsSet 2 [-1,0] [0,2.1] [0,0] [0,0] [0,0] [10,10] [0,0]", "tip-bias-voltage = 2.1"),
        ("MProbeBias.Set 2 -2.5", "tip-bias-voltage = -2.5 V is below"),
        ("Bias.Pulse 0 0.1 6 1 2", "x-pulse-voltage = 6 V is above the highest allowed, 5 V"),
        ("ZCtrl.SetpntSet 2e-9", "zctrl-setpoint = 2 nA is above"),
        ("Scan.BufferSet [0] 1024 1024", "1024 x 1024 pixels is above the highest number allowed"),
        ("BiasSpectr.LimitsSet -1 2", ""),
    ],
)
def test_command_that_sets_a_limited_quantity_is_judged_by_its_limits(tmp_path: Path, command: str, what: str) -> None:
    # spectra F11: the ends of a sweep had no limit
    limits = (
        '[limits]\nmost_pixels = 300_000\ntip-bias-voltage = { min = "-2 V", max = "2 V" }\n'
        'x-pulse-voltage = { max = "5 V" }\nzctrl-setpoint = { max = "1 nA" }\n'
    )
    found = errors(tmp_path, f'actions.x-own = {{ command = "{command}" }}\n' + limits)
    assert len(found) == bool(what), found
    assert all(what in one and "the limits would always refuse x-own" in one for one in found)


@pytest.mark.parametrize("ends", ["3 0", "0 3"])
def test_each_end_of_a_sweep_counts_for_forbidden_states(tmp_path: Path, ends: str) -> None:
    path = tmp_path / "experiment.toml"
    path.write_text(FRAME + f'actions.x-own = {{ command = "BiasSpectr.LimitsSet {ends}" }}\n')
    sets = load(path).resolved.limits.sets["x-own"]
    assert {one.name for one in sets} == {names.TIP_BIAS_VOLTAGE}
    assert sorted(float(one.value or "") for one in sets) == [0.0, 3.0]
