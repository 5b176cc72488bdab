"""A string that equals a top-level key stands for its value; overlays; only whole strings; no cycles."""

from __future__ import annotations

import pytest

from .conftest import Write, errors, line_of, only_error

SCANNER = '[scan]\ncomponent = true\nclass = "parts.Scanner"\n'


def test_a_string_that_is_a_key_is_replaced(write: Write) -> None:
    experiment = write('scan_size = ["1 um", "2 um"]\n' + SCANNER + 'size = "scan_size"\n')
    assert not errors(experiment)
    assert experiment.resolved.processes["scan"].settings["size"] == [1e-6, 2e-6]


def test_references_lead_on_to_references_within_lists(write: Write) -> None:
    experiment = write('wide = "3 um"\nscan_size = ["wide", "wide"]\n' + SCANNER + 'size = "scan_size"\n')
    assert experiment.resolved.processes["scan"].settings["size"] == [3e-6, 3e-6]


def test_a_part_of_a_string_is_not_replaced(write: Write) -> None:
    experiment = write('wide = "3 um"\n' + SCANNER + 'size = ["1 um", "1 um"]\nnames = ["wide.x", "a wide"]\n')
    assert experiment.resolved.processes["scan"].settings["names"] == ["wide.x", "a wide"]


def test_a_component_s_name_stays_a_name(write: Write) -> None:
    experiment = write(
        SCANNER + 'size = ["1 um", "1 um"]\nnames = ["scan", "scheduler", "clock"]\n[clock]\nspeed = 1.0\n'
    )
    assert not errors(experiment)
    assert experiment.resolved.processes["scan"].settings["names"] == ["scan", "scheduler", "clock"]


def test_a_component_that_is_switched_off_can_still_be_named(write: Write) -> None:
    limit = '[limits.tip-bias-voltage]\nonly = ["scan"]\n'
    experiment = write(SCANNER + limit, "[scan]\ncomponent = false\n")
    assert "there is no component 'scan'" in only_error(experiment).what


@pytest.mark.parametrize("text", ["[[limits]]\nmost_pixels = 10\n", "limits = 10\n"])
def test_a_section_that_is_no_table_is_an_error(write: Write, text: str) -> None:
    error = only_error(write(text))
    assert (error.what, error.place.line) == ("limits is a section, not a value or a list", 1)
    assert "[limits]" in error.hint


def test_a_dotted_string_stays_a_string(write: Write) -> None:
    experiment = write(SCANNER + 'size = ["1 um", "1 um"]\nnames = ["os.system"]\n')
    assert not errors(experiment)
    assert experiment.resolved.processes["scan"].settings["names"] == ["os.system"]


def test_reference_cycle_is_reported_once_with_its_line(write: Write) -> None:
    experiment = write('a = "b"\nb = ["c"]\nc = "a"\n' + SCANNER + 'size = ["1 um", "1 um"]\n')
    circle = only_error(experiment)
    assert "a -> b -> c -> a" in circle.what
    assert circle.place.line == 1


def test_key_that_is_its_own_value_is_a_cycle(write: Write) -> None:
    assert "a -> a" in only_error(write('a = "a"\n')).what


def test_overlay_changes_only_its_own_keys(write: Write) -> None:
    experiment = write(
        'scan_size = ["1 um", "1 um"]\n' + SCANNER + 'size = "scan_size"\ncount = 5\n',
        'scan_size = ["7 um", "7 um"]\n[scan]\nevery = "2 min"\n',
    )
    assert not errors(experiment)
    settings = experiment.resolved.processes["scan"].settings
    assert settings == {"size": [7e-6, 7e-6], "count": 5, "every": 120.0}


def test_the_last_of_several_overlays_wins(write: Write) -> None:
    experiment = write(SCANNER + 'size = ["1 um", "1 um"]\n', "[scan]\ncount = 1\n", "[scan]\ncount = 2\n")
    assert experiment.resolved.processes["scan"].settings["count"] == 2


def test_an_overlay_may_switch_a_component_off(write: Write) -> None:
    experiment = write(SCANNER + 'size = ["1 um", "1 um"]\n', "[scan]\ncomponent = false\n")
    assert not errors(experiment)
    assert "scan" not in experiment.component_names


def test_an_overlay_replaces_a_list_as_a_whole(write: Write) -> None:
    experiment = write(SCANNER + 'size = ["1 um", "1 um"]\nnames = ["a", "b"]\n', '[scan]\nnames = ["c"]\n')
    assert experiment.resolved.processes["scan"].settings["names"] == ["c"]


def test_error_in_an_overlay_has_its_file_and_line(write: Write) -> None:
    experiment = write(SCANNER + 'size = ["1 um", "1 um"]\n', '\n\n[scan]\nevery = "3 V"\n')
    error = only_error(experiment)
    assert error.place.file.endswith("over1.toml")
    assert error.place.line == line_of(experiment, "every", "over1.toml")


def test_settings_for_a_misspelt_component_are_an_error(write: Write) -> None:
    error = only_error(write(SCANNER.replace("scan", "scanner") + 'size = ["1 um", "1 um"]\n', "[scaner]\ncount = 2\n"))
    assert error.what == "[scaner] is neither a section nor a component"
    assert "did you mean [scanner]?" in error.hint
    assert error.place.file.endswith("over1.toml")
