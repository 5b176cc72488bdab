"""What came of all checks, as text and as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any

from afspm.testing.translators.support import Support


class Outcome(Enum):
    """What came of one check."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Result:
    """One check.

    Attributes:
        line: what was expected and what came, or why it was skipped.
        complaints: of a check that failed, the warnings and errors that were logged meanwhile.
        real_s: how long it took.
    """

    name: str
    title: str
    outcome: Outcome
    line: str = ""
    real_s: float = 0.0
    complaints: tuple[str, ...] = ()


@dataclass
class Report:
    """All of them.

    Attributes:
        translator: its class or command.
        lost: why the checks could not be finished; empty if they were.
        unrestored: what could not be put back, a line each.
        folder: with the log and all files.
    """

    translator: str = ""
    simulated: bool = False
    afspm: str = ""
    began: str = ""
    results: list[Result] = field(default_factory=list)
    support: Support = field(default_factory=Support)
    lost: str = ""
    unrestored: list[str] = field(default_factory=list)
    folder: str = ""

    @property
    def passed(self) -> bool:
        """Whether nothing was wrong; what is not supported is no fault."""
        return bool(self.results) and not (self.failed or self.lost or self.unrestored or self.support.errors)

    @property
    def failed(self) -> list[Result]:
        return [result for result in self.results if result.outcome is Outcome.FAILED]

    def count(self, outcome: Outcome) -> int:
        return sum(result.outcome is outcome for result in self.results)

    def to_json(self) -> str:
        """For programs: `passed`, the checks, and what is supported, with the controller's version."""
        facts: dict[str, Any] = {
            "passed": self.passed,
            "translator": self.translator,
            "controller": self.support.controller,
            "simulated": self.simulated,
            "afspm": self.afspm,
            "began": self.began,
            "lost": self.lost,
            "unrestored": self.unrestored,
            "wrong_answers": self.support.errors,
            "checks": [{**asdict(result), "outcome": result.outcome.value} for result in self.results],
            "actions": [{"name": name, "supported": has} for name, has in self.support.actions.items()],
            "parameters": [self._parameter(name) for name in self.support.parameters],
        }
        return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"

    def _parameter(self, name: str) -> dict[str, Any]:
        told = self.support.parameters[name]
        return {
            "name": name,
            "supported": told is not None,
            "value": None if told is None else told.value,
            "unit": None if told is None else told.unit,
            "settable": self.support.settable.get(name),
        }
