"""`python -m benchmarks [--short] [NAME …]`: measures (default: everything), prints a table, writes build/bench.json.

Exits with 1 where a target was missed, and with 3 where a measurement failed.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

from benchmarks.effort import SHORT, VARIABLE
from benchmarks.rows import MEASUREMENTS, Failure, Measurement, Row

MODULES = (
    "codec",
    "control",
    "scans",
    "sample_scans",
    "late_joiner",
    "translator",
    "controllers",
    "dead_time",
    "reading",
    "recording",
    "experiment",
    "dashboard",
)
RESULT = Path("build/bench.json")


def main(arguments: list[str]) -> int:
    names = {name for name in arguments if name != "--short"}
    if len(names) < len(arguments):
        os.environ[VARIABLE] = SHORT  # read where a measurement is imported
    for module in MODULES:
        importlib.import_module(f"benchmarks.{module}")
    if unknown := names - MEASUREMENTS.keys():
        print(f"there is no measurement {sorted(unknown)}; there are {sorted(MEASUREMENTS)}", file=sys.stderr)
        return 2
    rows: list[Row | Failure] = []
    print(f"{'':58} {'ours':>10} {'bare':>10} {'ratio':>7}  target", flush=True)
    for name, measure in MEASUREMENTS.items():
        if not names or name in names:
            for row in _measured(name, measure):
                rows.append(row)
                print(_line(row), flush=True)
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps([row.to_json() for row in rows], indent=1) + "\n", encoding="utf-8")
    if any(isinstance(row, Failure) for row in rows):
        return 3
    return 0 if all(isinstance(row, Row) and row.met for row in rows) else 1


def _measured(name: str, measure: Measurement) -> Iterator[Row | Failure]:
    try:
        yield from measure()
    except Exception as error:  # a failed measurement of any kind must not lose the others
        traceback.print_exc()
        yield Failure(name, f"{type(error).__name__}: {error}")


def _line(row: Row | Failure) -> str:
    if isinstance(row, Failure):
        return f"{row.name:58} FAILED: {row.error}"
    sign = "<=" if row.better == "low" else ">="
    bare = "" if row.bare is None else f"{row.bare:.4g}"
    mark = "" if row.met else "  MISSED"
    name = f"{row.name} [{row.unit}]"
    return f"{name:58} {row.ours:>10.4g} {bare:>10} {row.ratio:>7.2f}  {sign} {row.target:g}{mark}"


if __name__ == "__main__":
    # a shell that runs this in the background ignores Ctrl-C for it, and so would the experiments that it ends that way
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main(sys.argv[1:]))
