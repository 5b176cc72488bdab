"""Runs jobs in several processes."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from benchmarks.drift.parts import Job

CHUNK = 8


def done(jobs: Sequence[Job], processes: int) -> dict[Job, Sequence[Any]]:
    """Return the results of each job, run in `processes` processes with a progress bar."""
    results: dict[Job, Sequence[Any]] = {}
    columns = ("[progress.description]{task.description}", BarColumn(), MofNCompleteColumn())
    with (
        Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), transient=True) as progress,
        ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool,
    ):
        task = progress.add_task("jobs", total=len(jobs))
        chunks = [jobs[k : k + CHUNK] for k in range(0, len(jobs), CHUNK)]
        running: dict[Future[list[Sequence[Any]]], Sequence[Job]] = {pool.submit(_run, c): c for c in chunks}
        for future in as_completed(running):
            chunk = running[future]
            results.update(zip(chunk, future.result(), strict=True))
            progress.advance(task, len(chunk))
    return results


def _run(jobs: Sequence[Job]) -> list[Sequence[Any]]:
    return [job.run() for job in jobs]
