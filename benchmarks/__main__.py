"""`python -m benchmarks [--short] [--land] [NAME …]`: measures, prints a table, writes build/bench.json.

Without names everything is measured; `--short` tries each row once, and its figures mean nothing.

Beside each ratio stands the one of the last landed run (benchmarks/landed.json), which `--land` replaces. A measurement
that lacks a program or package is listed with its remedy, and the others go on.

Exits with 1 where a target was missed, and with 3 where a measurement failed.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from benchmarks import landed
from benchmarks.effort import SHORT, VARIABLE
from benchmarks.rows import MEASUREMENTS, Failure, Measurement, Missing, NotMeasured, Row, measurement

MODULES = (
    "codec",
    "control",
    "scans",
    "sample_scans",
    "late_joiner",
    "translator",
    "controllers",
    "dead_time",
    "sweep_at",
    "reading",
    "recording",
    "experiment",
    "dashboard",
)
RESULT = Path("build/bench.json")
OPTIONS = {"--short", "--land"}


def main(
    arguments: list[str],
    modules: Sequence[str] = MODULES,
    measurements: dict[str, Measurement] = MEASUREMENTS,
    file: Path = landed.FILE,
) -> int:
    options, names = {one for one in arguments if one.startswith("--")}, {*arguments}
    names -= options
    if "--short" in options:
        os.environ[VARIABLE] = SHORT  # read where a measurement is imported
    _register(modules)
    if unknown := (names - measurements.keys()) | (options - OPTIONS):
        known = f"measurements {sorted(measurements)} and options {sorted(OPTIONS)}"
        print(f"there is no {', '.join(sorted(unknown))}; there are {known}", file=sys.stderr)
        return 2
    before = landed.read(file)
    measured: dict[str, list[Row]] = {}
    found: list[Row | Failure | Missing] = []
    print(f"{'':58} {'ours':>10} {'bare':>10} {'ratio':>7} {'landed':>7}  target", flush=True)
    for name, measure in measurements.items():
        if not names or name in names:
            for row in _measured(name, measure, before.get(name, {})):
                found.append(row)
                if isinstance(row, Row):
                    measured.setdefault(name, []).append(row)
                print(_line(row, before.get(name, {})), flush=True)
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps([row.to_json() for row in found], indent=1) + "\n", encoding="utf-8")
    for missing in (row for row in found if isinstance(row, Missing)):
        print(f"not measured: {missing.name}: {missing.reason}")
    failed = {row.name for row in found if isinstance(row, Failure)}
    if "--land" in options:
        landed.write({name: rows for name, rows in measured.items() if name not in failed}, file)
    if failed:
        return 3
    return 0 if all(row.met for row in found if isinstance(row, Row)) else 1


def _register(modules: Sequence[str]) -> None:
    for module in modules:
        try:
            importlib.import_module(f"benchmarks.{module}")
        except ImportError as error:  # it needs a package of an extra: its measurements are listed, and the others made
            measurement(partial(_lacks, error), module)


def _lacks(error: ImportError) -> Iterator[Row]:
    raise _remedy(error)
    yield  # makes this a generator, as every measurement is


def _remedy(error: ImportError) -> NotMeasured:
    return NotMeasured(f"{error.name or error} is not installed", "run `python tools/bootstrap.py test`")


def _measured(name: str, measure: Measurement, landed_rows: Mapping[str, float]) -> Iterator[Row | Failure | Missing]:
    try:
        yield from measure()
    except NotMeasured as error:
        yield Missing(name, str(error), tuple(landed_rows))
    except ImportError as error:
        yield Missing(name, str(_remedy(error)), tuple(landed_rows))
    except Exception as error:  # a failed measurement of any kind must not lose the others
        traceback.print_exc()
        yield Failure(name, f"{type(error).__name__}: {error}")


def _line(row: Row | Failure | Missing, landed_rows: Mapping[str, float]) -> str:
    if isinstance(row, Failure):
        return f"{row.name:58} FAILED: {row.error}"
    if isinstance(row, Missing):
        return f"{row.name:58} NOT MEASURED: {row.reason}" + "".join(f"\n  {name}" for name in row.rows)
    sign = "<=" if row.better == "low" else ">="
    bare = "" if row.bare is None else f"{row.bare:.4g}"
    earlier = f"{landed_rows[row.name]:.2f}" if row.name in landed_rows else ""
    mark = "" if row.met else "  MISSED"
    name = f"{row.name} [{row.unit}]"
    return f"{name:58} {row.ours:>10.4g} {bare:>10} {row.ratio:>7.2f} {earlier:>7}  {sign} {row.target:g}{mark}"


if __name__ == "__main__":
    # a shell that runs this in the background ignores Ctrl-C for it, and so would the experiments that it ends that way
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main(sys.argv[1:]))
