"""run.json: what a run says of itself, to whoever joins it, resumes it or looks at it afterwards."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from afspm.basics.errors import FileError
from afspm.basics.plain_data import Plain

RUN_FILE: Final = "run.json"
STATE_DIR: Final = "state"
"""Beside it: what the processes remember."""
ENDED: Final = "ended"
"""In run.json once a run is over: how it ended, in words."""
REAL_S: Final = "real_s"
"""In run.json once a run is over: how long it took in real time, in all its parts, without what follows the end."""
REPLAY_OF: Final = "replay_of"
"""In run.json of a replay: the folder of the run that it publishes again."""
EXPERIMENT_FILE: Final = "experiment.toml"
"""Beside it: the experiment as it was expanded."""
COMPUTER: Final = "computer"
"""In run.json: the name of the computer that the run was started on."""
PLANNED: Final = "planned"
"""In run.json: the planned work of each component at the first start, as `PlannedWork.as_dict`."""
METADATA: Final = "metadata"
"""In run.json: what is written into every file about sample, people and microscope, by name."""
LATEST_LINK: Final = "latest"
"""In the folder of all runs: a link to the newest."""
LATEST_FILE: Final = "latest.txt"
"""Where no links can be made: a file with the name of the newest."""


def read_run_json(folder: Path) -> Plain:
    """Return what run.json in the folder of a run says.

    Raises:
        FileError: it is not there, can't be read, or is something else.
    """
    file = folder / RUN_FILE
    try:
        facts = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileError(f"can't be read: {error}", where=str(file)) from error
    if not isinstance(facts, dict):
        raise FileError("is not what a run leaves", where=str(file))
    return facts


def run_json_or_empty(folder: Path) -> Plain:
    """Return the same; empty where nothing can be read."""
    try:
        return read_run_json(folder)
    except FileError:
        return {}


def latest_run(runs: Path) -> Path | None:
    """Return the newest run in the folder of all runs; None: there is none."""
    link, file = runs / LATEST_LINK, runs / LATEST_FILE
    if link.is_dir():
        return runs / link.resolve().name
    return runs / file.read_text(encoding="utf-8").strip() if file.is_file() else None


def experiment_name(folder: Path, otherwise: str = "") -> str:
    """Return the name of the experiment that left a folder; `otherwise` if it is not known."""
    return str(run_json_or_empty(folder).get("name") or otherwise)
