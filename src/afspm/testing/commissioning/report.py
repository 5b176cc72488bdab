"""The report of a commissioning: one TOML file for people and programs, the source of the public matrix."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from afspm.basics.errors import FileError
from afspm.basics.plain_data import Plain
from afspm.experiment.toml_writer import dumps
from afspm.storage.atomic import write_atomic
from afspm.testing.commissioning.progress import CommissioningProgress, outcome_of, outcome_word
from afspm.testing.conformance import CheckResult

FORMAT: Final = 1
TRIED_ON: Final = ("instrument", "maker's program", "maker's client", "emulator")
"""The levels of the matrix, the best first."""
_HEAD = """# A commissioning report of afspm. Send it to have it in the public matrix (docs/reference/instruments.md).
# Its row there: {row}

"""


@dataclass(frozen=True)
class InstrumentReport:
    """Test results of the operations of one controller.

    Attributes:
        release: version of the controller's program, as reported by the program or by the person.
        tried_on: one of `TRIED_ON`.
        evidence: a command, or tests of the repository.
        operations: the outcome of each operation.
        steps: outcome and line of each step of `afspm commission`.
        claims: the verdicts on claims about the maker's program that steps settle, by id; see `MakerClaim`.
        unsupported: actions and parameters that the controller does not have.
        unrestored: settings that could not be restored.
        logged: the warnings and errors in the log of the last evening, each once with a count.
    """

    maker: str
    driver: str
    release: str
    tried_on: str
    evidence: str
    began: str
    afspm: str
    operations: Mapping[str, str]
    steps: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    claims: Mapping[str, str] = field(default_factory=dict)
    unsupported: Sequence[str] = ()
    unrestored: Sequence[str] = ()
    logged: Sequence[str] = ()
    note: str = ""
    format: int = FORMAT

    @property
    def row(self) -> str:
        """The row of the matrix, in Markdown."""
        outcomes = [f"{name}: {outcome}" for name, outcome in self.operations.items()]
        return f"| {self.maker} | {self.release} | {self.tried_on} | {', '.join(outcomes)} |"

    def write(self, file: Path) -> None:
        """Write the report as TOML. Raises FileError."""
        text = _HEAD.format(row=self.row) + dumps(asdict(self))
        write_atomic(file, [text.encode()])

    @classmethod
    def read(cls, file: Path) -> InstrumentReport:
        """Read a report.

        Raises:
            FileError: the file is unreadable or no report.
        """
        try:
            facts: Plain = tomllib.loads(file.read_text(encoding="utf-8"))
            found = cls(**facts)
            if found.format != FORMAT or found.tried_on not in TRIED_ON:
                raise ValueError(f"format {found.format}, tried on {found.tried_on!r}")
            return found
        except (OSError, ValueError, TypeError) as error:
            raise FileError(f"is not a commissioning report: {error}", where=str(file)) from error

    def results(self) -> dict[str, CheckResult]:
        return {
            name: CheckResult(name, "", outcome_of(one["outcome"]), one["line"]) for name, one in self.steps.items()
        }


def steps_of(progress: CommissioningProgress) -> dict[str, dict[str, str]]:
    """Return the results of the steps in the format of the report file."""
    return {name: {"outcome": outcome_word(one.outcome), "line": one.line} for name, one in progress.results.items()}
