"""Writes tests/system/matrix/matrix.toml from the outcomes of `make test-matrix`: `python tools/matrix.py FOLDER`."""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from pathlib import Path

RECORD = Path(__file__).parents[1] / "tests" / "system" / "matrix" / "matrix.toml"
HEAD = """\
# By job, component and instrument: done, no gain is good here, wrong (compared with the simulator's truth), or why
# `afspm check` refuses it. Written by `make test-matrix`.
"""


def main(folder: Path) -> None:
    rows = defaultdict[tuple[str, str], dict[str, str]](dict)
    for file in sorted(folder.glob("*.json")):
        job, instrument, outcomes = json.loads(file.read_text(encoding="utf-8"))
        for component, outcome in outcomes.items():
            rows[job, component][instrument] = outcome
    text = HEAD
    for (job, component), on in rows.items():
        text += f"\n[{job}.{json.dumps(component)}]\n"
        text += "".join(f"{instrument} = {json.dumps(on[instrument])}\n" for instrument in sorted(on))
    RECORD.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
