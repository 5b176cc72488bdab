"""The ledger of a run, from requests, positions and scans of its record."""

from __future__ import annotations

import pytest

from afspm.model import ControlRequest, ControlResponse, JournalEntry, Region, names
from afspm.night.treatment_ledger import TreatmentLedger, TreatmentPlace, treatment_ledger, treatment_times

S = 1_000_000_000


def sets(at_s: int, name: str, value: str, unit: str, response: int = 0) -> JournalEntry:
    return JournalEntry(
        *(at_s * S, "request", "corrector", "sets", response),
        request=int(ControlRequest.PARAM),
        subject=name,
        value=value,
        unit=unit,
    )


def acts(at_s: int, name: str, response: int = 0, who: str = "corrector", sent_s: int | None = None) -> JournalEntry:
    sent_ns = None if sent_s is None else sent_s * S
    action = int(ControlRequest.ACTION)
    return JournalEntry(at_s * S, "request", who, name, response, request=action, subject=name, sent_ns=sent_ns)


PULSE_SET = [sets(1, names.PULSE_VOLTAGE, "-4000", "mV"), sets(2, names.PULSE_DURATION, "50", "ms")]
CRASH_SET = [sets(1, names.CRASH_DEPTH, "5", "nm")]


def ledger_of(
    *journal: JournalEntry,
    at_m: tuple[float, float] = (8e-6, 0.0),
    feedback: tuple[tuple[int, bool], ...] = (),
    end_s: int = 100,
) -> TreatmentLedger:
    scanned = [(5 * S, Region((0.0, 0.0), (1e-6, 1e-6)))]
    return treatment_ledger(journal, [(0, at_m)], scanned, [(at_s * S, on) for at_s, on in feedback], end_s * S, 500e-9)


def test_pulses_and_crashes_are_summed_in_si() -> None:
    ledger = ledger_of(*PULSE_SET, acts(3, names.PULSE), *CRASH_SET, acts(4, names.CRASH), acts(5, names.CRASH))
    assert (ledger.pulses, ledger.crashes, ledger.treatments, ledger.unknown) == (1, 2, 3, 0)
    assert ledger.pulse_v_s == pytest.approx(0.2)
    assert ledger.crash_depth_m == pytest.approx(10e-9)
    assert ledger.by == {"corrector": 3}


def test_refused_requests_count_nothing_and_unanswered_actions_count() -> None:
    refused = int(ControlResponse.PARAM_ERROR)
    ledger = ledger_of(
        *CRASH_SET,
        sets(2, names.CRASH_DEPTH, "50", "nm", refused),
        acts(3, names.CRASH, int(ControlResponse.NOT_IN_CONTROL)),
        acts(4, names.CRASH, int(ControlResponse.NO_RESPONSE), sent_s=3),
    )
    assert ledger.crashes == 1
    assert treatment_times([acts(2, names.CRASH, int(ControlResponse.NOT_IN_CONTROL)), acts(3, names.PULSE)]) == [3 * S]
    assert ledger.crash_depth_m == pytest.approx(5e-9)


def test_treatment_with_several_answers_counts_once_by_its_last_answer() -> None:
    none = int(ControlResponse.NO_RESPONSE)
    slow = (
        acts(9, names.CRASH, none, sent_s=4),
        acts(15, names.CRASH, none, sent_s=4),
        acts(16, names.CRASH, sent_s=4),
    )
    again = acts(18, names.CRASH, sent_s=17)
    assert ledger_of(*CRASH_SET, *slow).crash_depth_m == pytest.approx(5e-9)
    assert ledger_of(*CRASH_SET, *slow, again).crash_depth_m == pytest.approx(10e-9)
    refused = acts(16, names.CRASH, int(ControlResponse.ACTION_ERROR), sent_s=4)
    assert ledger_of(*CRASH_SET, slow[0], refused).crashes == 0


def test_unsent_treatment_counts_nothing() -> None:
    unsent = [acts(at_s, names.PULSE, int(ControlResponse.NO_RESPONSE)) for at_s in (3, 4, 5)]
    assert ledger_of(*PULSE_SET, *unsent, acts(6, names.PULSE, sent_s=6)).pulses == 1


def test_treatment_of_unknown_size_is_counted_as_such() -> None:
    ledger = ledger_of(acts(3, names.PULSE), acts(4, names.CRASH, who="person"))
    assert (ledger.pulses, ledger.crashes, ledger.unknown) == (1, 1, 2)
    assert ledger.by == {"corrector": 1, "person": 1}


def test_treatment_near_a_region_counts_only_after_its_scan_began() -> None:
    near = (0.9e-6, 0.0)
    assert ledger_of(acts(4, names.PULSE), at_m=near).in_keep_away == 0
    assert ledger_of(acts(6, names.PULSE), at_m=near).in_keep_away == 1
    assert ledger_of(acts(6, names.PULSE), at_m=(1.1e-6, 0.0)).in_keep_away == 0


def test_place_of_a_treatment_is_the_last_position_before_it() -> None:
    place = (2e-6, 1e-6)
    assert ledger_of(acts(4, names.PULSE), acts(5, names.CRASH), at_m=place).places == (
        TreatmentPlace(names.PULSE, place),
        TreatmentPlace(names.CRASH, place),
    )
    unknown = treatment_ledger([acts(4, names.PULSE)], [(5 * S, place)], [], [], 9 * S, 500e-9)
    assert (unknown.pulses, unknown.places) == (1, ())


def test_time_with_the_feedback_off_excludes_a_retracted_tip() -> None:
    feedback = ((10, False), (20, True), (30, False))
    assert ledger_of(feedback=feedback, end_s=40).feedback_off_s == pytest.approx(20.0)
    withdrawn = (acts(32, names.RETRACT), acts(38, names.ENGAGE))
    assert ledger_of(*withdrawn, feedback=feedback, end_s=40).feedback_off_s == pytest.approx(14.0)
    assert ledger_of(feedback=((10, True),)).feedback_off_s == 0.0
