"""The cache on disk: the scheduler's own packets at once, what they take the place of a while later."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from afspm.clock import ExperimentClock
from afspm.model import Packet
from afspm.record import ahead
from afspm.scheduler import journal as module
from afspm.scheduler.journal import Journal


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    return made(tmp_path)


def made(tmp_path: Path) -> Journal:
    return Journal(tmp_path / "scheduler.cache", ExperimentClock.real(), logging.getLogger("scheduler"))


def packets(journal: Journal) -> list[Packet]:
    return [packet for packet, _ in journal.load()]


def keep(journal: Journal, packet: Packet) -> None:
    """Of the scheduler's own."""
    journal.note(packet, None, cached=True)


def test_the_schedulers_own_is_there_at_once(journal: Journal, tmp_path: Path) -> None:
    own = Packet("JournalEntries", b"x", 5)
    keep(journal, own)
    assert packets(made(tmp_path)) == [own]


def test_it_is_not_deleted_for_being_newer_than_what_is_followed(journal: Journal, tmp_path: Path) -> None:
    scan, own = Packet("Scan2d", b"s", 1), Packet("JournalEntries", b"x", 2)
    cached = [(scan, 1)]
    keep(journal, own)
    journal.follow(cached)
    journal.close()
    assert packets(made(tmp_path)) == [scan, own]


def test_what_is_no_longer_cached_is_deleted(journal: Journal, tmp_path: Path) -> None:
    old, new = Packet("JournalEntries", b"x", 1), Packet("JournalEntries", b"y", 2)
    keep(journal, old)
    keep(journal, new)
    journal.follow([(new, None)])
    journal.close()
    assert packets(made(tmp_path)) == [new]


def test_what_is_to_be_written_is_not_made_to_wait_for_what_is_only_to_be_deleted(journal: Journal) -> None:
    assert journal.due_s is None
    keep(journal, Packet("JournalEntries", b"x", 1))
    tidy_s = journal.due_s
    journal.note(Packet("Scan2d", b"s", 2), 2, cached=True)
    soon_s = journal.due_s
    assert tidy_s is not None
    assert soon_s is not None
    assert soon_s < tidy_s
    keep(journal, Packet("JournalEntries", b"x", 3))
    assert journal.due_s == soon_s


class PowerCutError(BaseException):
    """Nothing more is done."""


@pytest.mark.parametrize("steps", range(3))
def test_what_comes_out_of_the_cache_was_written_ahead_whenever_the_power_was_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    done = 0

    def until_cut(do: Callable[..., Any]) -> Callable[..., Any]:
        def step(*arguments: Any, **named: Any) -> Any:
            nonlocal done
            if done == steps:
                raise PowerCutError
            done += 1
            return do(*arguments, **named)

        return step

    monkeypatch.setattr(module, "_store", until_cut(module._store))
    monkeypatch.setattr(ahead.Ahead, "note", until_cut(ahead.Ahead.note))
    ahead.expect_record(tmp_path)
    own = Packet("ProcessStates_lab", b"x", 1)
    before = made(tmp_path)
    try:
        keep(before, own)
        assert steps == 2, "there was no cut"
    except PowerCutError:
        assert done == steps

    after = packets(made(tmp_path))
    recorded = [written.packet for written in ahead.written_ahead(tmp_path / "scheduler.ahead")]
    before.close()
    assert after == recorded == [own] * min(steps, 1)
