"""`python -m benchmarks [NAME …]`: measures (default: everything), prints a table, writes build/bench.json."""

from __future__ import annotations

import importlib
import json
import signal
import sys
from pathlib import Path

from benchmarks.rows import MEASUREMENTS, Row

MODULES = (
    "codec",
    "control",
    "scans",
    "late_joiner",
    "translator",
    "controllers",
    "reading",
    "recording",
    "experiment",
    "dashboard",
)
RESULT = Path("build/bench.json")


def main(names: list[str]) -> int:
    for module in MODULES:
        importlib.import_module(f"benchmarks.{module}")
    if unknown := set(names) - MEASUREMENTS.keys():
        print(f"there is no measurement {sorted(unknown)}; there are {sorted(MEASUREMENTS)}", file=sys.stderr)
        return 2
    rows: list[Row] = []
    print(f"{'':58} {'ours':>10} {'bare':>10} {'ratio':>7}  target", flush=True)
    for name, measure in MEASUREMENTS.items():
        if not names or name in names:
            for row in measure():
                rows.append(row)
                print(_line(row), flush=True)
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps([row.to_json() for row in rows], indent=1) + "\n", encoding="utf-8")
    return 0 if all(row.met for row in rows) else 1


def _line(row: Row) -> str:
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
