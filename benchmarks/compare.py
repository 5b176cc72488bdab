"""Measures two commits in turn on this computer: `python -m benchmarks.compare BEFORE [--after AFTER] NAME …`.

Each commit gets a worktree and an environment of its own in build/compare, which stay for the next comparison. The
commits are measured in pairs, before and after close together, so that other load affects both alike; the table has the
median quotient of the pairs and their range. The result is for reading and no gate: a computer that is busy now and
then can't decide about a few percent.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
Measured = dict[str, float]
"""The ratio of each row, or its absolute value, by name and unit."""


class Commit:
    """A commit with its worktree and environment."""

    def __init__(self, name: str, root: Path) -> None:
        described = subprocess.run(
            ["git", "rev-parse", "--short", "--verify", f"{name}^{{commit}}"],
            cwd=root, capture_output=True, encoding="utf-8", check=False,
        )  # fmt: skip
        if described.returncode != 0:
            raise SystemExit(f"there is no commit {name!r}: {described.stderr.strip()}")
        self.hash = described.stdout.strip()
        self.folder = root / "build" / "compare" / self.hash
        if not self.folder.exists():
            subprocess.run(["git", "worktree", "prune"], cwd=root, check=True)
            subprocess.run(
                ["git", "worktree", "add", "--quiet", "--detach", self.folder, self.hash], cwd=root, check=True
            )
        subprocess.run([sys.executable, "tools/bootstrap.py", "test"], cwd=self.folder, check=True)

    def measure(self, names: Sequence[str]) -> Measured:
        """Return the rows of these measurements; a measurement that fails has none."""
        python = self.folder / ".venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
        command = [str(python), "-m", "benchmarks", *names]
        done = subprocess.run(command, cwd=self.folder, capture_output=True, encoding="utf-8", check=False)
        if done.returncode == 2:
            raise SystemExit(f"{self.hash}: {done.stderr.strip()}")
        rows = json.loads((self.folder / "build" / "bench.json").read_text(encoding="utf-8"))
        return {f"{row['name']} [{row['unit']}]": row["ratio"] for row in rows if "ratio" in row}


def table(pairs: Sequence[tuple[Measured, Measured]]) -> Iterator[str]:
    """Yield a line for each row that both commits have, and one for each row that only one of them has."""
    for name in dict.fromkeys(name for pair in pairs for one in pair for name in one):
        both = [(before[name], after[name]) for before, after in pairs if name in before and name in after]
        if not both:
            yield f"{name:70} in one commit only"
            continue
        before, after = (statistics.median(column) for column in zip(*both, strict=True))
        if all(value for value, _ in both):
            quotients = [after / before for before, after in both]
            middle, low, high = statistics.median(quotients), min(quotients), max(quotients)
            yield f"{name:70} {before:>9.3g} {after:>9.3g}  x {middle:.3f}  ({low:.3f} to {high:.3f})"
        else:
            yield f"{name:70} {before:>9.3g} {after:>9.3g}"


def main(arguments: list[str], root: Path = ROOT) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", help="a commit")
    parser.add_argument("--after", default="HEAD", help="the other commit (default: HEAD)")
    parser.add_argument("names", nargs="*", metavar="NAME", help="measurements (default: all)")
    parser.add_argument("--pairs", type=int, default=5, help="the number of times that both are measured")
    given = parser.parse_intermixed_args(arguments)
    before, after = Commit(given.before, root), Commit(given.after, root)
    pairs = []
    for number in range(given.pairs):
        # the order alternates: the second of two may find the computer warmer, or busier
        if number % 2:
            second, first = after.measure(given.names), before.measure(given.names)
        else:
            first, second = before.measure(given.names), after.measure(given.names)
        pairs.append((first, second))
        print(f"pair {number + 1} of {given.pairs}", file=sys.stderr, flush=True)
    print(f"{'':70} {before.hash:>9} {after.hash:>9}  quotient of {given.pairs} pairs (range)")
    for line in table(pairs):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
