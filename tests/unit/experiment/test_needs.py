"""Needs of components are compared with the microscope's capabilities before a run."""

from __future__ import annotations

import pytest

from afspm.experiment import Experiment, Finding

from .conftest import FRAME, Write, errors, only_error

SIMULATED = FRAME[: FRAME.index("[microscope]")] + '[microscope]\ncomponent = true\nclass = "Simulator"\n'
SWAPPER = '[swapper]\ncomponent = true\nclass = "parts.Swapper"\n'
SERIES = '[series]\ncomponent = true\nclass = "ScanSeries"\nsize = ["1 um", "1 um"]\nscans = 2\n'
SOLVED = (
    '[control]\nsolved_by_hand = ["tip-shape-changed", "feedback-non-optimal", "thermal-drift", "device-malfunction"]\n'
)
ADDED = """
[microscope.parameters.x-drive]
vendor = "probe-pos-x"
[microscope.actions.x-swap-mode]
set = { x-spec-kind = "force" }
"""


def test_missing_capability_is_named_with_the_component_that_needs_it(write: Write) -> None:
    found = [finding.what for finding in errors(write(SWAPPER, frame=SIMULATED))]
    assert found == [
        "[swapper] needs the action 'x-swap-mode', which [microscope] does not have",
        "[swapper] needs the parameter 'x-drive', which [microscope] does not have",
    ]


def test_parameters_and_actions_added_by_the_file_count_as_capabilities(write: Write) -> None:
    assert errors(write(SWAPPER, frame=SIMULATED + ADDED)) == []


@pytest.mark.parametrize(
    ("kind", "action", "is_wrong"),
    [
        ("Park", '{ command = "spm.zstage.move(100, 1)" }', True),
        ("Gxsm", '{ command = "DSP_CMD_MOV-XP_XY" }', True),
        ("Nanosurf", '{ command = "root.workflow.mine()", withdrawn = true }', True),
        ("Nanosurf", '{ command = "root.workflow.mine()" }', False),
        ("Nanonis", '{ command = "Motor.StartMove 4 10 0 1" }', False),
        ("Simulator", "{ set = { scan-angle = 0 }, withdrawn = true }", False),
    ],
)
def test_action_for_a_withdrawn_tip_is_refused_where_no_tip_is_shown(
    write: Write, kind: str, action: str, is_wrong: bool
) -> None:
    # results m5: a stage that moves beside a tip at the sample
    frame = SIMULATED.replace("Simulator", kind) + f"actions = {{ x-step = {action} }}\n"
    found = [finding.what for finding in errors(write("", frame=frame))]
    what = "[microscope] actions.x-step: it needs a withdrawn tip, which this microscope never shows"
    assert found == ([what] if is_wrong else [])


def test_a_command_that_is_the_translator_may_have_everything(write: Write) -> None:
    assert errors(write(SWAPPER)) == []


def test_needs_of_a_component_follow_its_settings(write: Write) -> None:
    assert errors(write(SERIES + 'parameters = { scan-speed = "2 um/s" }\n', frame=SIMULATED)) == []
    error = only_error(write(SERIES + 'parameters = { scan-sped = "2 um/s" }\n', frame=SIMULATED))
    assert "[series] needs the parameter 'scan-sped'" in error.what
    assert "scan-speed" in error.hint


@pytest.mark.parametrize(
    "component",
    [
        SERIES,
        '[grid]\ncomponent = true\nclass = "SpectroscopyGrid"\npositions = [[0.0, 0.0]]\nkind = "IV"\n',
        '[tuner]\ncomponent = true\nclass = "FeedbackTuner"\nlowest_gain = 1.0\nhighest_gain = 9.0\n',
        '[repair]\ncomponent = true\nclass = "TipCorrector"\nworkshop_center = ["3 um", "3 um"]\n',
    ],
)
def test_simulator_has_all_needs_of_components(write: Write, component: str) -> None:
    experiment = write(component, frame=SIMULATED)
    assert errors(experiment) == []
    declared = [one.declared for one in experiment.resolved.processes.values() if one.declared.needs_actions]
    assert len(declared) == 1


SURVEY = '[survey]\ncomponent = true\nclass = "Survey"\nsize = "5 um"\nzoom = "500 nm"\n'
DRIFTING = (
    '[scheduler]\ncomponent = true\nclass = "DriftCompensatedScheduler"\n[rescanner]\ncomponent = true\n'
    'class = "Rescanner"\n[microscope]\ncomponent = true\nclass = "Simulator"\n'
)


def warnings(experiment: Experiment) -> list[Finding]:
    found = experiment.check()
    assert not any(finding.is_error for finding in found), found
    return [finding for finding in found if "pixels of the survey" in finding.what]


def test_survey_too_coarse_for_its_zooms_is_a_warning_if_drift_is_corrected(write: Write) -> None:
    coarse = SURVEY + "pixels = [128, 128]\n"
    (warning,) = warnings(write(coarse, frame=DRIFTING))
    assert "[survey] a zoom is 12.7 pixels of the survey wide" in warning.what
    assert warning.hint == "20 pixels are enough: pixels = [208, 208]"
    assert warning.place.line == 6
    assert not warnings(write(coarse.replace("128, 128", "208, 208"), frame=DRIFTING)), "its own cure"
    assert not warnings(write(coarse, frame=SIMULATED))


def test_by_default_a_survey_is_as_fine_as_its_zooms_need_up_to_a_limit(write: Write) -> None:
    assert not warnings(write(SURVEY, frame=DRIFTING))
    (warning,) = warnings(write(SURVEY.replace("500 nm", "100 nm"), frame=DRIFTING))
    assert warning.hint == '20 pixels are enough: zoom = "196 nm"'
    assert warning.place.line == 5
    assert not warnings(write(SURVEY.replace("500 nm", "196 nm"), frame=DRIFTING)), "its own cure"


def test_channel_that_the_microscope_lacks_is_refused_with_its_list(write: Write) -> None:
    picture = '[picture]\ncomponent = true\nclass = "NightPicture"\nchannel = "Hight"\n'
    error = only_error(write(picture, frame=SIMULATED))
    assert error.what == "[picture] channel: the microscope has no channel 'Hight'"
    assert "height (Height); height, retrace (Height Retrace); current (Current)" in error.hint
    named = SIMULATED + '[microscope.channels]\nother = "Hight"\n'
    assert errors(write(picture, frame=named)) == []


def test_role_that_only_another_mode_has_is_refused(write: Write) -> None:
    analysis = '[analysis]\ncomponent = true\nclass = "FeedbackAnalysis"\nchannel = "amplitude"\n'
    assert errors(write(analysis + SOLVED, frame=SIMULATED)) == []
    error = only_error(write(analysis + SOLVED, frame=SIMULATED + '[microscope.feedback]\nmode = "current"\n'))
    assert error.what == "[analysis] channel: the microscope has no role 'amplitude'"


# paper F5
@pytest.mark.parametrize("channel", ["current", "Current", "current, retrace", "potential"])
def test_channel_that_is_no_height_is_refused_where_heights_are_judged(write: Write, channel: str) -> None:
    judge = f'[judge]\ncomponent = true\nclass = "TipClassifier"\nchannel = "{channel}"\n' + SOLVED
    named = SIMULATED + '[microscope.channels]\n"current, retrace" = "Current Retrace"\npotential = "Bias"\n'
    error = only_error(write(judge, frame=named))
    quantity = channel.casefold().removesuffix(", retrace")
    assert error.what == f"[judge] channel: {channel!r} is not a height: it measures the {quantity}"
    assert "height (Height)" in error.hint


@pytest.mark.parametrize(
    ("component", "setting"),
    [("TipClassifier", "retrace_channel"), ("LineWatch", "channel"), ("FeedbackAnalysis", "height")],
)
def test_each_setting_of_heights_refuses_a_current(write: Write, component: str, setting: str) -> None:
    part = f'[part]\ncomponent = true\nclass = "{component}"\n{setting} = "current"\n'
    judge = '[judge]\ncomponent = true\nclass = "TipClassifier"\n'
    error = only_error(write(part + judge + SOLVED, frame=SIMULATED))
    assert error.what == f"[part] {setting}: 'current' is not a height: it measures the current"


def test_calibrated_deflection_is_a_height_to_the_check(write: Write) -> None:
    judge = '[judge]\ncomponent = true\nclass = "TipClassifier"\nchannel = "deflection"\n' + SOLVED
    assert errors(write(judge, frame=SIMULATED + '[microscope.channels]\ndeflection = "Deflection"\n')) == []


# users N9
@pytest.mark.parametrize(
    "judge",
    [
        'class = "TipClassifier"\n',
        'class = "TipCorrector"\njudge = "self"\nworkshop_center = ["4 um", "4 um"]\n',
    ],
)
@pytest.mark.parametrize(("scans", "reference", "warns"), [(3, 40, True), (3, 3, True), (4, 3, False), (41, 40, False)])
def test_judge_that_learns_from_all_planned_scans_is_a_warning(
    write: Write, judge: str, scans: int, reference: int, warns: bool
) -> None:
    part = f"[judge]\ncomponent = true\n{judge}reference_scans = {reference}\n" + SOLVED
    found = write(SERIES.replace("scans = 2", f"scans = {scans}") + part, frame=SIMULATED).check()
    of_judge = [one for one in found if "judges no scan" in one.what]
    assert len(of_judge) == warns
    if warns:
        assert of_judge[0].what.endswith(f"it learns from {reference} scans, and {scans} are planned")
        assert of_judge[0].place.line > 0


def test_judge_beside_a_series_without_end_may_learn_from_any_number(write: Write) -> None:
    part = '[judge]\ncomponent = true\nclass = "TipClassifier"\nreference_scans = 40\n' + SOLVED
    found = write(SERIES.replace("scans = 2\n", "") + part, frame=SIMULATED).check()
    assert not any("judges no scan" in one.what for one in found)


def test_channel_of_drift_is_compared_too(write: Write) -> None:
    drifting = '[scheduler]\ncomponent = true\nclass = "DriftCompensatedScheduler"\ndrift = { channel = "Z" }\n'
    error = only_error(write("", frame=drifting + SIMULATED[SIMULATED.index("[microscope]") :] + SOLVED))
    assert error.what == "[scheduler] drift.channel: the microscope has no channel 'Z'"


def test_wrong_role_in_the_file_is_an_error(write: Write) -> None:
    error = only_error(write("", frame=SIMULATED + '[microscope.channels]\nhight = "Height"\n'))
    assert "there is no role 'hight' of a channel" in error.what


def test_component_that_needs_lines_needs_a_microscope_that_publishes_them(write: Write) -> None:
    watch = (
        '[line_watch]\ncomponent = true\nclass = "LineWatch"\n'
        '[tip_classifier]\ncomponent = true\nclass = "TipClassifier"\n' + SOLVED
    )
    assert errors(write(watch, frame=SIMULATED)) == []
    error = only_error(write(watch, frame=SIMULATED + "live_lines_s = 0.0\n"))
    assert error.what == "[line_watch] subscribes to 'ScanLines', which no component publishes"


# paper F7
@pytest.mark.parametrize(
    ("subscriber", "envelope", "supplier"),
    [
        ("LineWatch", "SpatialROIWithScoreList", 'component with class = "TipClassifier"'),
        ("DriftTable", "DriftMapping", 'scheduler with class = "DriftCompensatedScheduler"'),
    ],
)
def test_missing_input_is_named_with_the_class_that_publishes_it(
    write: Write, subscriber: str, envelope: str, supplier: str
) -> None:
    error = only_error(write(f'[part]\ncomponent = true\nclass = "{subscriber}"\n' + SOLVED, frame=SIMULATED))
    assert error.what == f"[part] subscribes to {envelope!r}, which no component publishes"
    assert error.hint == f"it is published by a {supplier}: add it"


def test_lines_that_a_fast_clock_does_not_wait_for_are_a_warning(write: Write) -> None:
    watch = (
        '[line_watch]\ncomponent = true\nclass = "LineWatch"\n'
        '[tip_classifier]\ncomponent = true\nclass = "TipClassifier"\n' + SOLVED
    )
    fast = "[clock]\nspeed = 1200.0\n"
    late = "lines of scans may come too late for [line_watch], or not at all: the clock does not wait for it"
    assert late not in [one.what for one in write(watch, frame=SIMULATED + fast).check()]
    found = write(watch, frame=SIMULATED + fast + "waits = false\n").check()
    assert [one.hint for one in found if one.what == late] == ["leave waits out, or set speed = 60 or less"]
