"""Which messages there are, and which of them a component hears that says nothing."""

from __future__ import annotations

from afspm import wire


def test_what_is_told_of_processes_requests_and_logs_is_not_of_the_experiment() -> None:
    beside = set(wire.known_messages()) - set(wire.messages_of_the_experiment())
    assert {"JournalEntries", "LogLines", "ProcessStates", "Progress"} <= beside
    assert {"Scan2d", "Spec1d", "ControlState", "DriftMapping", "ScanLines"} <= set(wire.messages_of_the_experiment())


def test_no_prefix_of_the_experiment_brings_what_is_beside_it() -> None:
    of_it = wire.messages_of_the_experiment()
    assert not [name for name in set(wire.known_messages()) - set(of_it) if name.startswith(of_it)]
