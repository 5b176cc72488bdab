"""Nights with a coarse motor: no move strikes the tip, and each part of the interlock is needed for that."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.model import ControlMode, JournalEntry
from afspm.scheduler.safety.movers import MoverState
from afspm.testing import Bench
from tests.simulation.mover_nights import judged, night

SAMPLE = Path(__file__).parents[2] / "experiments" / "other_sites" / "experiment.toml"

LASTS_S = 200.0


@pytest.mark.parametrize("seed", [1, 5])
def test_no_move_strikes_the_tip(seed: int, tmp_path: Path) -> None:
    found = night(seed, tmp_path, lasts_s=LASTS_S)
    assert (found.struck, found.crashes, found.in_air) == (0, 0, 0)
    assert found.moves > 20
    assert found.scans > 2


def test_interlock_without_a_retraction_strikes_the_tip(tmp_path: Path) -> None:
    assert night(3, tmp_path, "retraction", LASTS_S).struck


def test_steps_believed_over_a_hand_at_the_motor_strike_the_tip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # tip T1
    monkeypatch.setattr(MoverState, "unknown", lambda state, **others: state)
    assert night(3, tmp_path, lasts_s=LASTS_S).struck


@pytest.mark.parametrize(("paused_at", "refused"), [("x-coarse-away", ["x-coarse-right"]), ("x-approach", [])])
def test_sample_goes_on_after_a_pause_on_its_way(paused_at: str, refused: list[str], tmp_path: Path) -> None:  # tip T1
    bench = Bench.of(SAMPLE, folder=tmp_path)
    while not any(entry.subject == paused_at for entry in entries(bench)):
        bench.run(until=bench.now_s + (0.01 if bench.scans else 0.2))
    for mode in (ControlMode.MANUAL, ControlMode.AUTOMATED):
        bench.set_mode(mode)
    bench.run(until=bench.now_s + 200.0)
    bench.close()
    assert [entry.subject for entry in entries(bench) if "others may have moved it" in entry.reason] == refused
    assert len(bench.scans) == 3
    assert (judged(tmp_path).struck, judged(tmp_path).crashes) == (0, 0)


def entries(bench: Bench) -> list[JournalEntry]:
    return [entry for published in bench.published("JournalEntries") for entry in published.entries]


def test_interlock_without_a_proof_measures_in_air(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("afspm.scheduler.safety.movers.MEASURES", frozenset())
    assert night(3, tmp_path, lasts_s=LASTS_S).in_air
