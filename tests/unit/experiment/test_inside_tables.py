"""Wrong settings within the tables of the simulated microscope: each is found at once, with its line."""

from __future__ import annotations

from .conftest import FRAME, Write, errors, line_of

WITHOUT_MICROSCOPE = FRAME[: FRAME.index("[microscope]")]
MICROSCOPE = '[microscope]\ncomponent = true\nclass = "Simulator"\n'
WRONG = """
tip = { radus_m = 1e-9, half_angle_deg = -3.0 }
noise = { whit_m = 1.0 }
surface = { kind = "steps", stepp_m = 1.0 }
initial = { scan-sped = "1 um/s" }

[[microscope.faults]]
kind = "late-reply"

[[microscope.faults]]
kind = "late-repyl"

[[microscope.panel]]
at_s = 4
set = { scan-angle = "3 V" }
"""
EACH = [
    ("tip.radus_m", "tip ="),
    ("tip.half_angle_deg", "tip ="),
    ("noise.whit_m", "noise ="),
    ("surface.stepp_m", "surface ="),
    ("initial.scan-sped", "initial ="),
    ("faults[1].kind", 'kind = "late-repyl"'),
    ("panel[0].set.scan-angle", "set ="),
]


def test_errors_in_all_tables_are_found_at_once(write: Write) -> None:
    experiment = write(MICROSCOPE + WRONG, frame=WITHOUT_MICROSCOPE)
    found = {error.what.split(":")[0]: error.place.line for error in errors(experiment)}
    assert found == {f"[microscope] {where}": line_of(experiment, line) for where, line in EACH}


def test_an_error_beside_the_tables_hides_none_within_them(write: Write) -> None:
    experiment = write(MICROSCOPE + 'seeed = 3\npoll_period_s = "3 V"\n' + WRONG, frame=WITHOUT_MICROSCOPE)
    said = "\n".join(error.what for error in errors(experiment))
    assert len(errors(experiment)) == len(EACH) + 2
    for where in ("seeed", "poll_period_s", *(where for where, _ in EACH)):
        assert where in said


def test_consequence_of_another_error_is_not_reported(write: Write) -> None:
    """A setpoint is a current or a voltage, depending on the mode of the feedback, which is wrong here."""
    wrong = 'feedback = 3\ninitial = { zctrl-setpoint = "100 pA" }\n'
    (error,) = errors(write(MICROSCOPE + wrong, frame=WITHOUT_MICROSCOPE))
    assert "feedback" in error.what
    wrong = wrong.replace("3", '{ mode = "curent" }', 1)
    (error,) = errors(write(MICROSCOPE + wrong, frame=WITHOUT_MICROSCOPE))
    assert "feedback.mode" in error.what


def test_row_of_parameters_is_checked_as_a_whole(write: Write) -> None:
    wrong = "parameters = { scan-angle = { rnge = [1, 2], sgn = 3 }, scan-speed = { unit = 3 } }\n"
    experiment = write(MICROSCOPE + wrong, frame=WITHOUT_MICROSCOPE)
    said = [error.what for error in errors(experiment)]
    assert len(said) == 3
    assert all("parameters.scan-" in what for what in said)
    assert {error.place.line for error in errors(experiment)} == {line_of(experiment, "parameters")}


def test_missing_picture_hides_no_other_error(write: Write) -> None:
    wrong = 'surface = { kind = "file", path = "./none.png" }\ntip = { radus_m = 1.0 }\nfeedback = { mode = "no" }\n'
    said = "\n".join(error.what for error in errors(write(MICROSCOPE + wrong, frame=WITHOUT_MICROSCOPE)))
    for what in ("none.png", "tip.radus_m", "feedback.mode"):
        assert what in said


def test_errors_in_settings_of_an_emulator_are_found_at_once(write: Write) -> None:
    emulated = '[controller]\ncomponent = true\nclass = "AsylumEmulator"\ntip = { radus_m = 1.0 }\n'
    emulated += 'noise = { whit_m = 1.0 }\nfaults = ["no-such"]\n'
    assert len(errors(write(emulated))) == 3


def test_row_that_is_no_table_is_an_error(write: Write) -> None:
    experiment = write(MICROSCOPE + "parameters = { tip-bias-voltage = 5 }\n", frame=WITHOUT_MICROSCOPE)
    assert "tip-bias-voltage" in " ".join(error.what for error in errors(experiment))
