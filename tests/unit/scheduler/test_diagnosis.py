"""The conclusions of `afspm doctor` from its measurements."""

from __future__ import annotations

import pytest

from afspm.transport import diagnosis
from afspm.transport.diagnosis import Handshake, Heard, Reach, Severity, Versions

ADDRESS = "tcp://microscope:29001"
OURS = Versions("0.2.0", "3.12.1", "4.3.5")


@pytest.mark.parametrize("reach", Reach)
def test_each_reason_for_no_connection_has_its_own_remedy(reach: Reach) -> None:
    found = diagnosis.of_address("scheduler", ADDRESS, reach, is_here=False, expected=True)
    assert (found.severity is Severity.FINE) == (reach is Reach.OPEN)
    assert found.code == ("reached" if reach is Reach.OPEN else reach.value)
    assert bool(found.remedy) == (reach is not Reach.OPEN)


def test_a_port_of_this_computer_is_free_before_the_experiment_runs() -> None:
    def judged(*, expected: bool) -> Severity:
        return diagnosis.of_address("scheduler", ADDRESS, Reach.REFUSED, is_here=True, expected=expected).severity

    assert judged(expected=False) is Severity.FINE
    assert judged(expected=True) is Severity.ERROR


@pytest.mark.parametrize(
    ("handshake", "code"),
    [
        (Handshake.DONE, "key-done"),
        (Handshake.KEY_REFUSED, "key-unknown"),
        (Handshake.FAILED, "key-mismatch"),
        (Handshake.SILENT, "key-mismatch"),
    ],
)
def test_unknown_key_differs_from_a_wrong_key(handshake: Handshake, code: str) -> None:
    assert diagnosis.of_handshake(ADDRESS, handshake, "supervisor", "scheduler").code == code


@pytest.mark.parametrize(("ahead_s", "said"), [(3600.0, "1 h 00 min ahead of"), (-7200.0, "2 h 00 min behind")])
def test_wrong_clock_is_reported_with_amount_and_sign(ahead_s: float, said: str) -> None:
    found = diagnosis.of_clock(ahead_s, 0.1)
    assert found.severity is Severity.WARNING
    assert said in found.what


def test_a_clock_is_not_blamed_for_a_slow_answer() -> None:
    assert diagnosis.of_clock(2.5, 2.0).severity is Severity.FINE


def test_only_a_different_afspm_version_is_warned_of() -> None:
    assert diagnosis.of_versions(OURS, None).severity is Severity.FINE
    assert diagnosis.of_versions(OURS, Versions("0.2.0", "3.13.0", "4.3.5")).severity is Severity.FINE
    found = diagnosis.of_versions(OURS, Versions("0.1.0", "3.12.1", "4.3.5"))
    assert (found.severity, found.remedy) == (Severity.WARNING, "install the same on both: afspm 0.1.0")


@pytest.mark.parametrize(
    ("free", "speed", "severities"),
    [
        (50e9, 100e6, ["fine", "fine"]),
        (5e9, 100e6, ["warning", "fine"]),
        (0.5e9, 5e6, ["error", "warning"]),
    ],
)
def test_disk_is_judged_by_space_and_speed(free: float, speed: float, severities: list[str]) -> None:
    assert [one.severity.value for one in diagnosis.of_disk("runs", int(free), speed)] == severities


def test_rates_are_averaged_over_the_time_listened() -> None:
    heard = Heard("Scan2d", 6, 3_000, 3.0)
    assert (heard.rate_hz, heard.bytes_per_s) == (2.0, 1000.0)
    assert diagnosis.of_publisher(ADDRESS, [heard], caught_up=True).severity is Severity.FINE
    assert diagnosis.of_publisher(ADDRESS, [], caught_up=False).severity is Severity.ERROR


def test_little_memory_is_warned_of_with_the_largest_processes() -> None:
    found = diagnosis.of_memory(500_000_000, {"small": 1_000_000, "large": 900_000_000})
    assert found.severity is Severity.WARNING
    assert found.what == "0.5 GB available, large 900 MB, small 1 MB"
