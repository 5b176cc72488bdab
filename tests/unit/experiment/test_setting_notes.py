"""`afspm check` notes what a person may overlook where several plans state settings."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from afspm.cli.app import app
from afspm.experiment import Experiment, Finding
from afspm.experiment.setting_notes import SettingNotes

from .conftest import FRAME, Write, line_of

AMPLITUDE = FRAME[: FRAME.index("[microscope]")] + '[microscope]\ncomponent = true\nclass = "Simulator"\n'
CURRENT = AMPLITUDE + 'feedback = { mode = "current", setpoint = 100e-12 }\n'
ROWS = '[microscope.parameters.x-{0}]\nvendor = "LockIn.ModPhas {1}"\nunit = "deg"\n'
NANONIS = AMPLITUDE.replace("Simulator", "Nanonis") + ROWS.format("drive", 1) + ROWS.format("lent", 2) + "lent = true\n"
AFTER = 'after = ["near"]\n'
ZERO = "passes zero, where a feedback on the current drives the tip to the sample"


def series(name: str, parameters: str = "", more: str = "") -> str:
    """Return a plan whose scans take 64 s at the simulator's default speed."""
    plan = f'[{name}]\ncomponent = true\nclass = "ScanSeries"\nsize = ["1 um", "1 um"]\npixels = [64, 64]\n{more}'
    return plan + (f"parameters = {{ {parameters} }}\n" if parameters else "")


def sweep(name: str, parameters: str, more: str = "") -> str:
    return f'[{name}]\ncomponent = true\nclass = "Sweep"\nparameters = {{ {parameters} }}\n{more}'


def curves(name: str, kind: str, more: str = "") -> str:
    plan = f'[{name}]\ncomponent = true\nclass = "SpectroscopyGrid"\ncounts = [2, 2]\nspacing = ["1 nm", "1 nm"]\n'
    return f'{plan}kind = "{kind}"\n{more}'


def volts(value: str) -> str:
    return f'tip-bias-voltage = "{value} V"'


def notes(experiment: Experiment) -> list[Finding]:
    assert experiment.check() == [], "a note is no finding of the file"
    return SettingNotes(experiment.resolved).all()


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        (series("a", 'move-speed = "1 um/s"'), "set it at the panel"),
        (series("a", 'x-drive = "1 deg"'), "set it at the panel; a row of your own may have `lent = true`"),
        (series("b") + sweep("a", "x-drive = [1, 2]"), "begin the others `after` [a]"),
    ],
)
def test_stated_parameter_that_cannot_be_lent_has_a_note(write: Write, text: str, hint: str) -> None:
    experiment = write(text, frame=NANONIS)
    (note,) = notes(experiment)
    assert "can't be lent: once set, it is in force for the measurements of others, too" in note.what
    assert (note.place.line, note.hint) == (line_of(experiment, "parameters"), hint)


def test_parameter_that_may_be_lent_or_is_set_back_has_no_note(write: Write) -> None:
    assert notes(write(series("a", 'x-lent = "1 deg", scan-speed = "1 um/s"'), frame=NANONIS)) == []
    assert notes(write(sweep("a", "x-drive = [1, 2]"), frame=NANONIS)) == []
    assert notes(write(series("a", 'scan-angle = "5 deg"'), frame=NANONIS)) == [], "scans have regions of their own"


SPEED = 'scan-speed = "2 um/s"'
SWEPT = 'curve = { sweep = ["-1 V", "1 V"] }\n'
MODULATED = 'curve = { lock_in = { amplitude = "5 mV" } }\n'


@pytest.mark.parametrize(
    ("lender", "plan", "base", "hint"),
    [
        (series("a", volts("1")), series("b", SPEED), "tip-bias-voltage", "state it here, too"),
        (series("a", volts("1") + ", " + SPEED), curves("b", "IV", SWEPT), "tip-bias-voltage", "set it at the panel"),
        (curves("a", "IV", MODULATED), curves("b", "IV", SWEPT), "x-lock-in-amplitude", "set it at the panel"),
        (curves("a", "force", MODULATED), curves("b", "IV", SWEPT), "", ""),
        (curves("a", "IV", MODULATED), series("b", SPEED), "", ""),
        (series("a", volts("1")), series("b"), "", ""),
        (series("a", 'x-pulse-voltage = "4 V"'), series("b", SPEED), "", ""),
    ],
)
def test_plan_at_the_base_of_a_parameter_has_a_note(write: Write, lender: str, plan: str, base: str, hint: str) -> None:
    found = [(note.what, note.hint) for note in notes(write(lender + plan)) if note.what.startswith("[b]")]
    what = f"[b] measures at the base of {base}, which is the value at the panel"
    assert found == ([(what, f"if it needs the value in [a], {hint}")] if base else [])


@pytest.mark.parametrize(
    ("limits", "far", "waits"),
    [
        ('rate = "10 mV/s"', "", "waits up to 36 s"),  # 100 s, of which 64 s pass in a scan
        ('rate = "10 mV/s"\nstep = "0.1 V"', "", "waits up to 1 min 30 s"),  # the first of ten steps passes
        ('every = "20 s"\nstep = "0.5 V"', "", "waits up to 20 s"),
        ('rate = "14.5 mV/s"', "", ""),  # 69 s: less than a tenth of a scan
        ('step = "0.1 V"', "", ""),
        ('every = "30 s"', "", ""),
        ('rate = "10 mV/s"', AFTER, ""),
    ],
)
def test_wait_of_alternating_plans_for_a_limit_has_a_note(write: Write, limits: str, far: str, waits: str) -> None:
    text = f"[limits.tip-bias-voltage]\n{limits}\n" + series("near", volts("1")) + series("far", volts("2"), far)
    found = [note.what for note in notes(write(text, frame=AMPLITUDE))]
    assert found == [f"between [near], [far] each change of tip-bias-voltage {waits}"] * bool(waits)


def test_bias_below_a_tenth_at_the_same_setpoint_has_a_note(write: Write) -> None:
    def found(near: str, far: str, frame: str = CURRENT) -> list[str]:
        return [note.what for note in notes(write(series("near", near) + series("far", far), frame=frame))]

    note = "[near] measures at 50 mV, [far] at 1 V: at equal setpoint the tip comes closer"
    both = ', zctrl-setpoint = "50 pA"'
    assert found(volts("0.05"), volts("1")) == found(volts("0.05") + both, volts("1") + both) == [note]
    assert found(volts("0.05"), volts("1"), FRAME) == [note], "a microscope in another language may hold a current"
    assert found(volts("0.1"), volts("1")) == found(volts("0.05"), volts("1"), AMPLITUDE) == []
    assert note not in found(volts("0.05") + both, volts("1") + both.replace("50", "60"))


def test_bias_that_passes_zero_has_a_note(write: Write) -> None:
    two = series("near", volts("1")) + series("far", volts("-1"))
    between = f"tip-bias-voltage is above zero in [near], below in [far]: between them it {ZERO}"
    loop = sweep("loop", 'tip-bias-voltage = ["-1 V", "0 V", "1 V"]')
    assert [note.what for note in notes(write(two, frame=CURRENT))] == [between]
    assert [note.hint for note in notes(write(loop, frame=CURRENT))] == [
        'choose bias_through_zero = "hold" in [microscope] if the bias is ramped there, else "jump"'
    ]
    chosen = CURRENT + 'bias_through_zero = "hold"\n'
    for text, frame in ((two, AMPLITUDE), (two, chosen), (loop, AMPLITUDE), (loop.replace('"-1 V", ', ""), CURRENT)):
        assert notes(write(text, frame=frame)) == []


def test_period_beside_a_plan_that_keeps_control_has_a_note(write: Write) -> None:
    rounds, kept = series("near", "", 'every = "10 min"\n'), "keep_control = true\n"
    experiment = write(rounds + curves("iv", "IV", kept), frame=CURRENT)
    (note,) = notes(experiment)
    assert note.what == "[iv] keeps control until its end: rounds of [near] wait for it, beyond their `every`"
    assert (note.place.line, note.hint) == (line_of(experiment, "keep_control"), "leave keep_control out")
    for text in (curves("iv", "IV"), series("iv", "", kept + AFTER)):
        assert notes(write(rounds + text, frame=CURRENT)) == []
    assert notes(write(series("near") + curves("iv", "IV", kept), frame=CURRENT)) == []
    cryo = '[cryo]\ncomponent = true\nclass = "Instrument"\naddress = "secop://a:1"\nparameters = { "cryo.T" = "tt" }\n'
    (note,) = notes(write(rounds + cryo + sweep("warm", '"cryo.T" = ["4 K", "6 K"]'), frame=CURRENT))
    assert note.hint == "begin it `after` [near]"


def test_check_prints_the_notes(write: Write) -> None:
    experiment = write(sweep("loop", 'tip-bias-voltage = ["-1 V", "1 V"]'), frame=CURRENT)
    result = CliRunner().invoke(app, ["check", str(experiment.files[0])])
    assert f"note: [loop] tip-bias-voltage has both signs: it {ZERO}" in result.output
