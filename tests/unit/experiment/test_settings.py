"""Settings of a component are checked against its constructor (names, types, units), and reach it in SI."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from afspm.basics.launch import Launch
from afspm.experiment import class_loader, load
from afspm.transport.process import loading

from .conftest import Write, errors, line_of, only_error


def scanner(settings: str = "", size: str = 'size = ["1 um", "1 um"]') -> str:
    return f'[scan]\ncomponent = true\nclass = "parts.Scanner"\n{size}\n{settings}\n'


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ('every = "15 min"', 900.0),
        ("every = 7", 7.0),
        ('angle = "180 deg"', pytest.approx(3.14159265)),
        ("count = 5", 5),
        ('style = "slow"', "slow"),
        ('names = ["a"]', ["a"]),
    ],
)
def test_a_setting_reaches_the_process_in_si_and_as_json(write: Write, setting: str, value: object) -> None:
    experiment = write(scanner(setting))
    assert not errors(experiment)
    settings = experiment.resolved.processes["scan"].settings
    assert settings[setting.split(" ")[0]] == value
    json.dumps(settings)


def test_quantity_that_stays_a_text_is_a_warning(write: Write) -> None:
    table = '[loose]\ncomponent = true\nclass = "parts.Untyped"\nlabel = "3 times"\ntyped = "1 um"\nsize = "1 um"\n'
    (finding,) = write(table).check()
    assert not finding.is_error
    assert "[loose] size = '1 um' stays a text" in finding.what
    assert "size: Length" in finding.hint


def test_a_relative_file_is_one_beside_the_experiment_file(write: Write) -> None:
    experiment = write(scanner('image = "surface.png"'))
    assert Path(experiment.resolved.processes["scan"].settings["image"]) == experiment.folder / "surface.png"


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ('every = "3 mV"', "mV can't be converted to s"),
        ('every = "soon"', "not a number with a unit"),
        ("every = true", "not a quantity"),
        ("every = nan", "not a finite number"),
        ('every = "inf s"', "not a finite number"),
        ('count = "many"', "count is a whole number, not 'many'"),
        ("count = 2.5", "a whole number"),
        ('style = "fast"', "'quick' or 'slow'"),
        ('names = "a"', "list of values in brackets"),
        ("angle = 45", "without a unit this means 45 rad"),
        ("angle = 5", "5 has no unit"),
    ],
)
def test_a_wrong_value_is_an_error_on_its_line(write: Write, setting: str, said: str) -> None:
    experiment = write(scanner(setting))
    error = only_error(experiment)
    assert said in error.what
    assert "[scan]" in error.what
    assert error.place.line == line_of(experiment, setting.split(" ")[0])


@pytest.mark.parametrize(
    ("size", "said"),
    [('"1 um"', "is a list of values in brackets"), ('["1 um", "1 um", "1 um"]', "has 3 values, and takes 2")],
)
def test_a_list_of_the_wrong_length_is_an_error(write: Write, size: str, said: str) -> None:
    assert f"[scan] size {said}" in only_error(write(scanner(size=f"size = {size}"))).what


@pytest.mark.parametrize("setting", ["every = '15 mn'", "every = '3 nm'", "every = 'soon'"])
def test_wrong_quantity_is_an_error_with_an_example(write: Write, setting: str) -> None:
    assert only_error(write(scanner(setting))).hint == 'a time, for example "15 min"'


def test_alternatives_of_a_type_are_one_error(write: Write) -> None:
    table = '[a]\ncomponent = true\nclass = "parts.Alternatives"\n'
    assert (
        "[a] either is a whole number or a text in quotes, not [3]" in only_error(write(table + "either = [3]\n")).what
    )
    assert "[a] span[1] = '2 V'" in only_error(write(table + 'span = ["1 um", "2 V"]\n')).what
    assert "[a] span[0] = 2: without a unit" in only_error(write(table + 'span = [2, "1 um"]\n')).what


def test_parameters_of_planned_scans_need_their_units(write: Write) -> None:
    table = '[series]\ncomponent = true\nclass = "ScanSeries"\nsize = ["1 um", "1 um"]\n'
    error = only_error(write(table + "parameters = { scan-speed = 8 }\n"))
    assert error.what == "[series] parameters.scan-speed: without a unit this means 8 m/s"
    assert not errors(write(table + 'parameters = { scan-speed = "8 um/s" }\n'))


def test_a_wrong_element_of_a_list_is_named(write: Write) -> None:
    error = only_error(write(scanner(size='size = ["1 um", "2 s"]')))
    assert "[scan] size[1]" in error.what


def test_an_unknown_setting_is_an_error_with_the_nearest_name(write: Write) -> None:
    error = only_error(write(scanner('evry = "15 min"')))
    assert "no setting 'evry'" in error.what
    assert "'every'" in error.hint


def test_setting_of_a_class_replaced_by_an_overlay_is_an_error_with_its_place(tmp_path: Path) -> None:
    first, second = tmp_path / "night.toml", tmp_path / "other.toml"
    first.write_text('[a]\ncomponent = true\nclass = "ScanSeries"\nsize = ["1 um", "1 um"]\n')
    second.write_text('[a]\nclass = "Metadata"\n')
    (error,) = [e for e in load(first, second).check() if "'size'" in e.what]
    assert error.place.file == str(first)
    assert "other.toml" in error.hint


def test_a_missing_setting_is_an_error(write: Write) -> None:
    experiment = write(scanner(size=""))
    error = only_error(experiment)
    assert "needs the setting 'size'" in error.what
    assert error.place.line == line_of(experiment, "[scan]")


def test_misspelt_required_setting_is_reported_once(write: Write) -> None:
    error = only_error(write(scanner(size='sise = ["1 um", "1 um"]')))
    assert "'size'" in error.hint


def test_a_class_that_takes_anything_gets_anything(write: Write) -> None:
    experiment = write('[a]\ncomponent = true\nclass = "parts.Anything"\nwhatever = { x = [1, "two"] }\n')
    assert not errors(experiment)
    assert experiment.resolved.processes["a"].settings == {"whatever": {"x": [1, "two"]}}


def test_settings_passed_on_to_the_base_class_are_checked_by_its_signature(write: Write) -> None:
    text = '[a]\ncomponent = true\nclass = "parts.Derived"\nextra = 1\nsize = ["1 um", "1 um"]\n'
    assert not errors(write(text))
    assert "'every'" in only_error(write(text + "evry = 3\n")).hint


def test_all_errors_are_found_at_once(write: Write) -> None:
    experiment = write(scanner('every = "3 mV"\ncuont = 3\nstyle = "fast"') + "[clock]\nsped = 2\n")
    assert len(errors(experiment)) == 4


def test_findings_are_in_the_order_of_the_lines(write: Write) -> None:
    lines = [e.place.line for e in errors(write(scanner('style = "fast"\nevery = "3 mV"') + "[clock]\nsped = 2\n"))]
    assert lines == sorted(lines)
    assert len(lines) == 3


@pytest.mark.parametrize(
    ("name", "said", "hint"),
    [
        ("parts.Scaner", "has no 'Scaner'", "Scanner"),
        ("part.Scanner", "no module 'part'", "parts"),
        ("parts.NoComponent", "is not a component", "Component"),
        ("ScanSerie", "no ready-made class 'ScanSerie'", "ScanSeries"),
        ("broken.X", "SyntaxError", ""),
        ("raising.X", "ZeroDivisionError", ""),
        ("needing.X", "needs 'not_there_at_all'", "install"),
        ("time.X", "time has no 'X'", "rename time.py"),
        ("leaving.X", "SystemExit: 3 (leaving.py:2)", ""),
        ("afspm.components.planned_scans.ScanSerie", "has no 'ScanSerie'", "ScanSeries"),
        (
            "afspm.plugins.published.peers.PublishedPeers",
            "no module 'afspm.pl",
            'class = "PublishedPeers"; the package',
        ),
    ],
)
def test_class_that_can_not_be_loaded_is_an_error(
    write: Write, tmp_path: Path, name: str, said: str, hint: str
) -> None:
    (tmp_path / "broken.py").write_text("def f(:\n")
    (tmp_path / "raising.py").write_text("1 / 0\n")
    (tmp_path / "time.py").write_text("class X: ...\n")
    (tmp_path / "leaving.py").write_text("import sys\nsys.exit(3)\n")
    (tmp_path / "needing.py").write_text("import not_there_at_all\n")
    experiment = write(f'[a]\ncomponent = true\nclass = "{name}"\n')
    error = only_error(experiment)
    assert said in error.what
    assert hint in error.hint
    assert error.place.line == line_of(experiment, "class")


def test_modules_of_two_experiments_with_the_same_name_are_kept_apart(write: Write, tmp_path: Path) -> None:
    text = '[a]\ncomponent = true\nclass = "own.Own"\n'
    own = "from afspm.client.component import Component\nclass Own(Component):\n    def __init__(self, {}: int): ...\n"
    (tmp_path / "own.py").write_text(own.format("first"))
    assert "'first'" in only_error(write(text)).what
    (tmp_path / "own.py").write_text(own.format("another"))
    assert "'another'" in only_error(write(text)).what


OBJECT = """
scan_size = "2 um"
[my_plan]
class = "parts.Plan"
size = "scan_size"
[planner]
component = true
class = "parts.Planner"
plan = "my_plan"
more = ["my_plan"]
"""


def test_user_intermediary_class_is_constructed_in_the_process(write: Write, tmp_path: Path) -> None:
    experiment = write(OBJECT)
    assert experiment.check() == []
    settings = experiment.resolved.processes["planner"].settings
    assert settings == {"plan": {"class": "parts.Plan", "size": 2e-6}, "more": [settings["plan"]]}
    with class_loader.importing_from([tmp_path]):
        made: Any = loading.load(Launch("planner", "parts.Planner", json.loads(json.dumps(settings))))
    assert (made.plan.size, made.plan.rounds, made.more[0].size) == (2e-6, 1, 2e-6)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('size = "scan_size"', 'size = "2 V"', "V can't be converted to m"),
        ("size = ", "sizes = ", "no setting 'sizes'"),
        ('"parts.Plan"', '"parts.Plam"', "has no 'Plam'"),
    ],
)
def test_the_settings_of_an_intermediary_class_are_checked(write: Write, old: str, new: str, said: str) -> None:
    found = errors(write(OBJECT.replace(old, new)))
    assert found
    assert all(said in error.what for error in found)
