"""Every shipped component and scheduler does one small job on every instrument, or the check refuses the job.

A cell is done if its result agrees with the truth of the simulated world (`proofs`). A run that does not end is neither
done nor wrong: its test fails, and says so.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from rotation import rotated
from tests.system.experiment.experiment_lab import Run
from tests.system.matrix.matrix_lab import (
    CELLS,
    ELSEWHERE,
    IMPOSSIBLE,
    OUTSIDE,
    SECOND_FILES,
    files,
    recorded,
    refusal,
)
from tests.system.matrix.proofs import DONE, NO_GAIN, PROOFS, outcomes

from afspm.basics import entry_points

WRITTEN = os.environ.get("AFSPM_MATRIX", "")
"""Folder for the outcomes of a run that writes the record again."""


def kind(outcome: str) -> str:
    """Return an outcome without the numbers of one run."""
    return outcome if outcome.startswith(IMPOSSIBLE) else outcome.partition(":")[0]


def test_every_component_has_a_job_or_a_reason_for_none() -> None:
    names = entry_points.names(entry_points.COMPONENTS, entry_points.SCHEDULERS)
    ours = ("afspm.", "afspm_agents.")
    shipped = {name for name in names if str(entry_points.class_path(name)).startswith(ours)}
    assert {one.partition(" ")[0] for job in PROOFS.values() for one in job} | {*ELSEWHERE} == shipped


def test_record_has_an_outcome_for_every_cell() -> None:
    known = {
        (job, component, instrument)
        for job, of_job in recorded().items()
        for component, on in of_job.items()
        for instrument in on
    }
    wanted = {(job, component, instrument) for job, instrument in CELLS for component in PROOFS[job]}
    assert {cell for cell in known if cell[2] not in OUTSIDE.keys() - SECOND_FILES.keys()} == wanted


@pytest.mark.parametrize(("job", "instrument"), CELLS)
def test_check_refuses_what_the_record_calls_impossible(tmp_path: Path, job: str, instrument: str) -> None:
    of_cell = {on[instrument] for on in recorded()[job].values()}
    impossible = {one for one in of_cell if one.startswith(IMPOSSIBLE)}
    refused = refusal(files(tmp_path / "jobs", job, instrument))
    assert impossible == ({f"{IMPOSSIBLE}{refused}"} if refused else set())
    assert not (impossible and len(of_cell) > 1)


@pytest.mark.slow
@pytest.mark.parametrize(("job", "instrument"), rotated(CELLS, len(CELLS) // 6) if not WRITTEN else CELLS)
def test_job_has_the_recorded_outcome(afspm_run: Run, tmp_path: Path, job: str, instrument: str) -> None:
    # paper F3: a proof was a word in the log
    pytest.importorskip("matplotlib")
    of_cell = files(tmp_path / "jobs", job, instrument)
    if refused := refusal(of_cell):
        found = dict.fromkeys(PROOFS[job], f"{IMPOSSIBLE}{refused}")
    else:
        one = afspm_run(*map(str, of_cell), "--runs", str(tmp_path / "runs"), where=tmp_path)
        assert one.end() == 0, f"not finished: {one.output}"
        found = outcomes(job, one.folder)
        if {*found.values()} == {DONE}:
            errors = [line for line in one.lines if re.search(r" CRITICAL |Traceback", line)]
            assert not errors, f"not finished without errors: {one.output}"
    if WRITTEN:
        Path(WRITTEN).mkdir(parents=True, exist_ok=True)
        (Path(WRITTEN) / f"{job}-{instrument}.json").write_text(json.dumps([job, instrument, found]), encoding="utf-8")
    else:
        expected = {component: kind(on[instrument]) for component, on in recorded()[job].items()}
        assert {component: kind(outcome) for component, outcome in found.items()} == expected, found


@pytest.mark.slow
def test_bounds_without_a_good_gain_are_neither_done_nor_wrong(afspm_run: Run, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    low = tmp_path / "low.toml"
    low.write_text("[tuner]\nhighest_gain = 200.0\n", encoding="utf-8")
    of_cell = (*files(tmp_path / "jobs", "feedback", "simulator"), low)
    one = afspm_run(*map(str, of_cell), "--runs", str(tmp_path / "runs"), where=tmp_path)
    assert one.end() == 0, f"not finished: {one.output}"
    assert outcomes("feedback", one.folder) == {"FeedbackAnalysis": DONE, "FeedbackTuner": NO_GAIN}
