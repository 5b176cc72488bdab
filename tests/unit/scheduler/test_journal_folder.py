"""The cache on disk: the scheduler's own packets at once, what they take the place of a while later."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from afspm.clock import ExperimentClock
from afspm.model import Packet
from afspm.scheduler.journal import Journal


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    return made(tmp_path)


def made(tmp_path: Path) -> Journal:
    return Journal(tmp_path / "scheduler.cache", ExperimentClock.real(), logging.getLogger("scheduler"))


def packets(journal: Journal) -> list[Packet]:
    return [packet for packet, _ in journal.load()]


def test_the_schedulers_own_is_there_at_once(journal: Journal, tmp_path: Path) -> None:
    own = Packet("JournalEntries", b"x", 5)
    journal.keep(own)
    assert packets(made(tmp_path)) == [own]


def test_it_is_not_deleted_for_being_newer_than_what_is_followed(journal: Journal, tmp_path: Path) -> None:
    scan, own = Packet("Scan2d", b"s", 1), Packet("JournalEntries", b"x", 2)
    cached = [(scan, 1)]
    journal.keep(own)
    journal.follow(cached)
    journal.close()
    assert packets(made(tmp_path)) == [scan, own]


def test_what_is_no_longer_cached_is_deleted(journal: Journal, tmp_path: Path) -> None:
    old, new = Packet("JournalEntries", b"x", 1), Packet("JournalEntries", b"y", 2)
    journal.keep(old)
    journal.keep(new)
    journal.follow([(new, None)])
    journal.close()
    assert packets(made(tmp_path)) == [new]


def test_what_is_to_be_written_is_not_made_to_wait_for_what_is_only_to_be_deleted(journal: Journal) -> None:
    assert journal.due_s is None
    journal.keep(Packet("JournalEntries", b"x", 1))
    tidy_s = journal.due_s
    journal.changed()
    soon_s = journal.due_s
    assert tidy_s is not None
    assert soon_s is not None
    assert soon_s < tidy_s
    journal.keep(Packet("JournalEntries", b"x", 2))
    assert journal.due_s == soon_s
