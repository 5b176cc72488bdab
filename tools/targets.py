"""Where each target of the Makefile runs, and which one of the nightly is in turn: `python tools/targets.py` prints it.

`.ci/run` and `.ci/nightly` list their own; LEFT_OUT has all others, with the reason. `.ci/run` also runs one target of
IN_TURN, another at each commit, so that none of the nightly stays red for long without being seen.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

LEFT_OUT: Final = {
    "bench-compare": "compares two commits that a person names",
    "bench-drift": "takes half an hour, and misses some thirty of its targets at present; an eighth of it runs in turn",
    "bench-guests": "takes hours, and ends with an error by a target that it misses",
    "changelog": "moves the news fragments, at a release",
    "clean": "deletes",
    "dev": "installs hooks into a person's clone; `make check` sets up the same environment",
    "mutants": "a part of `make test` with all cases, as the nightly runs it",
    "messages": "compiles message classes, as every set-up does",
    "real-data-record": "writes the record that `make real-data` compares with",
    "scanner-nights": "has no targets: its figures are for reading",
    "test-nexus": "a part of test-tiled",
    "test-samples": "a part of test-slow",
    "test-times": "`make test` with a table",
    "test-windows": "takes hours under Wine",
}
IN_TURN: Final = {
    "acts": "CASES=6",
    "as-reported": "",
    "bench-drift": "EIGHTH=1",
    "chaos": "NIGHTS=4",
    "crowd": "",
    "demo": "",
    "demo-drift": "",
    "mutants": "",
    "power-cut": "CUTS=20",
    "real-data": "",
    "release-check": "",
    "replay-nights": "NIGHTS=40",
    "simulate": "HOURS=2000",
    "soak": "MESSAGES=100000 CALLS=5000",
    "test-apart": "",
    "test-clients": "",
    "test-gateway": "",
    "test-hosts": "",
    "test-lowest": "",
    "test-matrix": "",
    "test-nion": "",
    "test-octave": "",
    "test-plug-ins": "",
    "test-tiled": "",
}
"""Targets with the settings by which they take minutes."""
NOT_IN_TURN: Final = {
    "test-programs": "skips what the computer of the changes lacks, which is all of it",
    "bench": "judges speed, which other work on the computer changes; test-apart runs each row once",
    "coverage": "the tests of `make test` once more",
    "test-all": "its parts run at every change",
}
"""Targets of the nightly alone."""


def in_turn(number: int) -> str:
    """Return the target for the commit of this number, with its settings."""
    target = sorted(IN_TURN)[number % len(IN_TURN)]
    return f"{target} {IN_TURN[target]}".strip()


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
    from rotation import commit_number

    sys.stdout.write(f"{in_turn(commit_number())}\n")
