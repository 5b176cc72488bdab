"""Experiment files with several faults: each is found in one check, at the line of its key."""

from __future__ import annotations

import pytest

from .conftest import Write, line_of

SURVEY = """
[survey]
component = true
class = "Survey"
size = "5 um"
zoom = "500 nm"
parameters = { scan-speed = "20 um/s" }

[limits]
region = { x = ["-2 um", "2 um"], y = ["-2 um", "2 um"] }

[limits.scan-speed]
max = "10 um/s"
"""
GRANT = """
[control]
agents = ["agent"]

[agent]
component = true
class = "Gateway"

[limits.roles.agent]
actions = ["start-scna", "fly"]
parameters = { tip-bias = ["-1 V", "1 V"], scan-speed = ["5 um/s", "1 um/s"] }
per_hour = { start-scan = -30, start-spec = "many" }
"""
NOTIFY = """
[notify]
command = ["/nowhere/call_me"]
on = ["ends"]
unsolved_after = "-5 min"
"""
SERIES = """
[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
scans = 3
"""
REPAIR = """
[tip_corrector]
component = true
class = "TipCorrector"
"""
PULSE = SERIES + REPAIR + 'workshop_center = ["8 um", "0 um"]\npulse_voltages = ["3 V", "-400 V"]\n'
WORKSHOP = SERIES + REPAIR + 'workshop_center = ["0 um", "0 um"]\n'
CONSTRUCTORS = """
[series]
component = true
class = "ScanSeries"
size = ["1 um", "-1 um"]
scans = 3
retakes = -1

[repair]
component = true
class = "TipCorrector"
workshop_center = ["8 um", "0 um"]
problem = 3
most_treatments = 0
crash_speed = "-1 nm/s"
place_spacing = "0 nm"
night_pulses = -1
"""
CASES = {
    "survey": (SURVEY, {"[survey]": ["corner (-2.5, -2.5) µm lies outside"], "parameters =": ["scan-speed = 20 µm/s"]}),
    "grant": (
        GRANT,
        {
            "actions =": ["no action 'start-scna'", "no action 'fly'"],
            "parameters =": ["no parameter 'tip-bias'", "scan-speed: the first value is above the second"],
            "per_hour =": ["start-scan is at least 0, not -30", "start-spec is a whole number"],
        },
    ),
    "notify": (
        NOTIFY,
        {
            "command =": ["there is no program '/nowhere/call_me'"],
            "on =": ["not 'ends'"],
            "unsolved_after =": ["'-5 min' is not above 0 s"],
        },
    ),
    "pulse": (PULSE, {"pulse_voltages =": ["pulse_voltages[1] is -400 V"]}),
    "workshop": (WORKSHOP, {"workshop_center =": ["lies in the region that [series] scans"]}),
    "constructors": (
        CONSTRUCTORS,
        {
            "size =": ["a region of 1 x -1 µm is empty"],
            "retakes =": ["-1 retakes"],
            "problem =": ["a text in quotes, not 3"],
            "most_treatments =": ["must be at least 1"],
            "crash_speed =": ["a crash needs a depth and a speed above zero"],
            "place_spacing =": ["`place_spacing` must be above zero"],
            "night_pulses =": ["night_pulses: a budget can't be negative"],
        },
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_each_fault_of_a_file_is_found_at_the_line_of_its_key(case: str, write: Write) -> None:
    text, wanted = CASES[case]
    experiment = write(text)
    found = [(one.place.line, one.what) for one in experiment.check()]
    expected = [(line_of(experiment, key), what) for key, whats in wanted.items() for what in whats]
    assert len(found) == len(expected), found
    for line, what in expected:
        assert any(what in said and at == line for at, said in found), (line, what, found)


def test_pulse_that_a_limit_allows_is_meant(write: Write) -> None:
    assert write(PULSE + '\n[limits.x-pulse-voltage]\nmin = "-400 V"\nmax = "5 V"\n').check() == []


def test_error_that_may_come_of_another_is_not_reported(write: Write) -> None:
    """Without its wrong `scans` a series has no end; once they are right, it has."""
    wrong = SERIES.replace("scans = 3", "scans = -3\nend_when_done = true")
    (error,) = write(wrong).check()
    assert "at least 1 round, not -3" in error.what
