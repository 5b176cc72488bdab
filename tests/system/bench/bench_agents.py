"""Agents of the tests, imported in the agent's own process."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
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


class Hostile:
    """Tries to keep its trials out of the table, in each task by another deed."""

    def solve(self, session: TrialSession) -> None:
        session.report("cannot")
        deeds = {
            "operate/settings": _end_the_experiment,
            "operate/places": _cut_the_clock,
            "operate/curves": _leave_a_pipe,
            "find/highest": _fill_the_output,
            "find/flat": _nest_folders,
        }
        deeds[session.task](session)


def _end_the_experiment(session: TrialSession) -> None:
    session.scope.end_experiment()


def _cut_the_clock(session: TrialSession) -> None:
    mapped, cut = set(), []
    for maps in Path("/proc").glob("*/maps"):
        with suppress(OSError):
            mapped |= {line.split()[-1] for line in maps.read_text().splitlines() if os.environ["SPIED"] in line}
    for path in mapped:
        with suppress(OSError):
            os.truncate(path, 0)
            cut.append(path)
    own = [line for line in Path("/proc/self/maps").read_text().splitlines() if os.environ["SPIED"] in line]
    session.report("cannot", {"cut": cut, "own": own})


def _leave_a_pipe(session: TrialSession) -> None:
    (session.folder / "report.json").unlink()
    os.mkfifo(session.folder / "report.json")


def _fill_the_output(session: TrialSession) -> None:
    while True:
        os.write(2, bytes(1 << 20))


def _nest_folders(session: TrialSession) -> None:
    for _ in range(3000):
        Path("inner").mkdir()
        os.chdir("inner")


class Chatterer:
    """Says something else than that it is ready, and does not end."""

    def __init__(self) -> None:
        os.write(1, b"not yet\n")
        threading.Event().wait()

    def solve(self, session: TrialSession) -> None: ...
