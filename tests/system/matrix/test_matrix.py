"""Every shipped component and scheduler does one small job on every instrument, or the check refuses the job."""

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
    DONE,
    ELSEWHERE,
    OUTSIDE,
    PROOFS,
    SECOND_FILES,
    files,
    recorded,
    refusal,
)

from afspm.basics import entry_points

NO_GAIN = "no gain is good"  # a result, too: the feedback of each controller has its own range
WRITTEN = os.environ.get("AFSPM_MATRIX", "")
"""Folder for the outcomes of a run that writes the record again."""


def test_every_component_has_a_job_or_a_reason_for_none() -> None:
    shipped = {*entry_points.names(entry_points.COMPONENTS), *entry_points.names(entry_points.SCHEDULERS)}
    assert {*(one for job in PROOFS.values() for one in job), *ELSEWHERE} == shipped


def test_record_has_an_outcome_for_every_cell() -> None:
    known = {(job, instrument) for job, of_job in recorded().items() for instrument in of_job}
    assert {cell for cell in known if cell[1] not in OUTSIDE.keys() - SECOND_FILES.keys()} == set(CELLS)


@pytest.mark.parametrize(("job", "instrument"), CELLS)
def test_check_refuses_what_the_record_calls_impossible(tmp_path: Path, job: str, instrument: str) -> None:
    outcome = recorded()[job][instrument]
    assert refusal(files(tmp_path / "jobs", job, instrument)) == ("" if outcome == DONE else outcome)


@pytest.mark.slow
@pytest.mark.parametrize(("job", "instrument"), rotated(CELLS, len(CELLS) // 6) if not WRITTEN else CELLS)
def test_job_is_done(afspm_run: Run, tmp_path: Path, job: str, instrument: str) -> None:
    pytest.importorskip("matplotlib")
    of_cell = files(tmp_path / "jobs", job, instrument)
    outcome = refusal(of_cell) or DONE
    if outcome == DONE:
        one = afspm_run(*map(str, of_cell), "--runs", str(tmp_path / "runs"), where=tmp_path)
        assert one.end() == 0, one.output
        wrong = [line for line in one.lines if re.search(r" CRITICAL |Traceback", line) and NO_GAIN not in line]
        assert not wrong, one.output
        missing = [component for component, proof in PROOFS[job].items() if not proof(one)]
        assert not missing, f"{missing}: {one.output}"
    if WRITTEN:
        Path(WRITTEN).mkdir(parents=True, exist_ok=True)
        (Path(WRITTEN) / f"{job}-{instrument}.json").write_text(
            json.dumps([job, list(PROOFS[job]), instrument, outcome]), encoding="utf-8"
        )
    else:
        assert outcome == recorded()[job][instrument]
