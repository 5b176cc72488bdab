"""Writes tests/system/matrix/matrix.toml from the outcomes of `make test-matrix`: `python tools/matrix.py FOLDER`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

RECORD = Path(__file__).parents[1] / "tests" / "system" / "matrix" / "matrix.toml"
HEAD = "# By job and instrument: done, or why `afspm check` refuses it. Written by `make test-matrix`.\n"


def main(folder: Path) -> None:
    jobs: dict[str, str] = {}
    for file in sorted(folder.glob("*.json")):
        job, components, instrument, outcome = json.loads(file.read_text(encoding="utf-8"))
        head = f"\n[{job}]\ncomponents = {json.dumps(components)}\n\n[{job}.on]\n"
        jobs[job] = jobs.get(job, head) + f"{instrument} = {json.dumps(outcome)}\n"
    RECORD.write_text(HEAD + "".join(jobs.values()), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
