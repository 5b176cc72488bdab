"""Runs tests with the Windows Python of `python.py`: `python3 tools/windows/run_tests.py FOLDER …`, two at a time.

A test that takes too long or crashes ends its process there: it is named, and its folder goes on behind it. At the end
stands what passed, failed and was skipped, and why. What each folder said is in build/windows/tests/.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
OUTPUT = ROOT / "build" / "windows" / "tests"
AT_A_TIME = 2
LONGEST_S = 2400.0
"""So long a process may take; pytest's own limit ends a test that hangs long before that."""
CRASHES = 5
"""A folder with so many of them is given up."""
OPTIONS = ("-p", "no:cacheprovider", "-p", "outcomes", "-o", "timeout=480")
os.environ["AFSPM_OUTCOMES"] = ""

from outcomes import read  # noqa: E402  (beside this file)


@dataclass
class Found:
    """What came of the tests of a folder.

    Attributes:
        outcomes: of each test passed, failed or skipped.
        reasons: how often each reason for a skipped test was given.
        crashed: what ended its process, and with which exit code.
    """

    folder: str
    outcomes: dict[str, str] = field(default_factory=dict)
    reasons: Counter[str] = field(default_factory=Counter)
    crashed: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def failed(self) -> list[str]:
        return [test for test, outcome in self.outcomes.items() if outcome == "failed"]

    def __str__(self) -> str:
        counted = Counter(self.outcomes.values())
        parts = [f"{counted[outcome]} {outcome}" for outcome in ("passed", "failed", "skipped") if counted[outcome]]
        parts += [f"{len(self.crashed)} crashed"] if self.crashed else []
        return f"{self.folder:<36} {', '.join(parts) or 'no tests'} in {self.seconds:.0f} s"


def run_folder(folder: str) -> Found:
    """Run the tests of a folder, again and again until one process has reached the end of them."""
    found, began_s = Found(folder), time.monotonic()
    name = folder.strip("/").replace("/", "-").removesuffix(".py")
    report, log = OUTPUT / f"{name}.jsonl", OUTPUT / f"{name}.txt"
    report.unlink(missing_ok=True)
    log.unlink(missing_ok=True)
    while len(found.crashed) < CRASHES:
        known = len(read(report))
        code = _run(folder, report, log)
        lines = read(report)
        if lines[-1:] and lines[-1][0] == "ended":
            break
        finished = {test for what, test, *_ in lines if what == "finished"}
        begun = [test for what, test, *_ in lines[known:] if what == "begun" and test not in finished]
        found.crashed.append(f"{begun[-1] if begun else folder} ({code})")
        if len(lines) == known:
            break  # not even its tests could be collected
    _count(read(report), found)
    found.seconds = time.monotonic() - began_s
    return found


def _run(folder: str, report: Path, log: Path) -> str:
    """Run the tests of a folder that have not begun yet; return how the process ended."""
    with log.open("ab") as output:
        process = subprocess.Popen(
            [sys.executable, str(HERE / "python.py"), "-m", "pytest", *OPTIONS, folder],
            cwd=ROOT,
            env={**os.environ, "AFSPM_OUTCOMES": str(report), "PYTHONPATH": str(HERE)},
            stdout=output,
            stderr=output,
        )
        try:
            return f"exit code {process.wait(LONGEST_S)}"
        except subprocess.TimeoutExpired:
            process.terminate()
            process.wait()
            return f"still there after {LONGEST_S:.0f} s"


def _count(lines: list[list[str]], found: Found) -> None:
    for what, test, *reason in lines:
        if what in ("begun", "finished", "ended") or found.outcomes.get(test) == "failed":
            continue
        found.outcomes[test] = what
        if what == "skipped":
            found.reasons[reason[0].removeprefix("Skipped: ")] += 1


def _summary(all_found: list[Found]) -> Iterator[str]:
    reasons = sum((found.reasons for found in all_found), Counter())
    yield from (f"skipped {count:>4}  {reason}" for reason, count in reasons.most_common())
    yield from (f"failed        {test}" for found in all_found for test in found.failed)
    yield from (f"crashed       {test}" for found in all_found for test in found.crashed)
    counted = Counter(outcome for found in all_found for outcome in found.outcomes.values())
    crashed = sum(len(found.crashed) for found in all_found)
    yield (
        ", ".join(f"{counted[outcome]} {outcome}" for outcome in ("passed", "failed", "skipped"))
        + f", {crashed} crashed"
    )


def _say(*lines: str) -> None:
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


def main() -> None:
    """Run the folders named; exit with 1 where a test failed or crashed."""
    OUTPUT.mkdir(parents=True, exist_ok=True)
    began_s, all_found = time.monotonic(), []
    with ThreadPoolExecutor(AT_A_TIME) as pool:
        for done in as_completed([pool.submit(run_folder, folder) for folder in sys.argv[1:]]):
            all_found.append(done.result())
            _say(str(all_found[-1]))
    _say("", *_summary(all_found))
    _say(f"in {(time.monotonic() - began_s) / 60:.0f} minutes; what each folder said is in {OUTPUT.relative_to(ROOT)}")
    sys.exit(any(found.failed or found.crashed for found in all_found))


if __name__ == "__main__":
    main()
