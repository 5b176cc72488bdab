"""Agents of the tests, imported in the agent's own process."""

from __future__ import annotations

import os
from pathlib import Path

from afspm_bench.session import TrialSession


class Spy:
    """Looks for the truth where the test says that it is."""

    def solve(self, session: TrialSession) -> None:
        sealed = Path(os.environ["SPIED"])
        found = [str(file) for file in sealed.rglob("*") if _is_readable(file)]
        session.report("cannot", {"found": found})


def _is_readable(file: Path) -> bool:
    try:
        return bool(file.read_bytes())
    except OSError:
        return False


class Sleeper:
    """Never ends by itself."""

    def solve(self, session: TrialSession) -> None:
        session.report("cannot")
        session.scope.sleep(1e9)


class Broken:
    """Fails in the middle of its task."""

    def solve(self, session: TrialSession) -> None:
        (session.folder / "report.json").write_text('{"status": "perhaps"}', encoding="utf-8")
        raise RuntimeError("a fault of the agent")
