"""The ratios of the last landed run, in benchmarks/landed.json: `python -m benchmarks --land [NAME …]` writes them.

Only ratios are kept: an absolute time of another computer says nothing about this one. A run of some measurements
replaces these, and keeps the others.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from benchmarks.rows import Row

FILE = Path(__file__).with_name("landed.json")
Ratios = dict[str, dict[str, float]]
"""The ratio of each row, by measurement and name of the row."""


def read(file: Path = FILE) -> Ratios:
    if not file.exists():
        return {}
    ratios: Ratios = json.loads(file.read_text(encoding="utf-8"))
    return ratios


def write(measured: Mapping[str, list[Row]], file: Path = FILE) -> None:
    """Replace the ratios of these measurements."""
    ratios = read(file)
    for name, rows in measured.items():
        kept = {row.name: float(f"{row.ratio:.3g}") for row in rows if row.bare is not None}
        ratios.pop(name, None)
        if kept:
            ratios[name] = kept
    text = json.dumps(dict(sorted(ratios.items())), indent=1, ensure_ascii=False)
    file.write_text(text + "\n", encoding="utf-8", newline="\n")
