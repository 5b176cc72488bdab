"""`TrialSession`: an agent's access to one trial."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from afspm import Scope
from afspm.basics import Clock, PlainMapping
from afspm.components import write_atomic
from afspm.emulation import World
from afspm_bench.evidence import Report

REPORT_FILE = "report.json"


class BenchAgent(Protocol):
    """Interface of an agent in Python: a class without constructor arguments."""

    def solve(self, session: TrialSession) -> None:
        """Do the task of the session, and report the answer."""
        ...


@dataclass(frozen=True)
class TrialSession:
    """One trial, from the agent's side.

    Attributes:
        scope: the microscope; `scope.scan(…)`, `scope.spectrum(…)`, `scope.set(…)` as in a script.
        prompt: the task in words. given: facts of the task, in SI units.
        documents: texts that belong to the task, by file name.
        clock: clock of the experiment.
        began_ns: experiment time of the start. minutes: experiment time after which the trial ends.
        seed: seed for the agent's own random numbers, independent of the sample.
        folder: the agent's own folder, which is its current folder.
        truth_folder: folder of the run, for the oracle; None for all other agents.
    """

    task: str
    scope: Scope
    prompt: str
    given: PlainMapping
    documents: Mapping[str, str]
    clock: Clock
    began_ns: int
    minutes: float
    seed: int
    folder: Path
    truth_folder: Path | None = None

    @property
    def elapsed_minutes(self) -> float:
        """Experiment time since the start of the trial, in minutes."""
        return (self.clock.now_ns() - self.began_ns) / 60e9

    def thinking(self) -> AbstractContextManager[None]:
        """Slow the experiment down to real time during the `with` block, for at most ten real minutes."""
        return self.clock.late()

    def report(
        self,
        status: str,
        answer: PlainMapping | None = None,
        cites: Sequence[int | str | None] = (),
        asks: Sequence[str] = (),
    ) -> None:
        """Submit the report; a later report replaces an earlier report.

        Args:
            status: "done", "cannot" or "ask".
            cites: `time_ns` of each scan or spectrum that supports the answer.
            asks: names of facts missing from the prompt.

        Raises:
            InvalidValue: a field of the report is invalid.
        """
        plain = {"status": status, "answer": dict(answer or {}), "cites": list(cites), "asks": list(asks)}
        Report.from_plain(plain)
        write_atomic(self.folder / REPORT_FILE, [json.dumps(plain).encode()])

    def true_world(self) -> World:
        """Return the true world at the start, for the oracle. Raises FileNotFoundError for all other agents."""
        if self.truth_folder is None:
            raise FileNotFoundError("the truth is sealed")
        first = json.loads((self.truth_folder / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0])
        return World.from_settings(first["settings"], int(first["seed"]), float(first["time_s"]))
