"""run.json: the facts about a run, for processes that join, resume or read the run."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from afspm.basics.errors import FileError
from afspm.basics.plain_data import Plain, from_json

RUN_FILE: Final = "run.json"
STATE_DIR: Final = "state"
"""Folder beside run.json: saved memory of the processes."""
ENDED: Final = "ended"
"""Key in run.json, after the end of a run: its end as text."""
REAL_S: Final = "real_s"
"""Key in run.json, after the end of a run: its real duration, summed over its parts."""
UNFINISHED: Final = "unfinished"
"""Key in run.json, after the end of a run: how each unfinished component was stopped, as text by name."""
WAITS_GIVEN_UP: Final = "waits_given_up"
"""Key in run.json, after the end of a run: how often simulated time went on without a process that was behind."""
REPLAY_OF: Final = "replay_of"
"""Key in run.json of a replay: the folder of the replayed run."""
EXPERIMENT_FILE: Final = "experiment.toml"
"""File beside run.json: the expanded experiment."""
FEEDBACK_OFF: Final = "feedback_off"
"""Key in run.json: the experiment times, in ns, at which a person began or resumed the run with `--feedback-off`."""
COMPUTER: Final = "computer"
"""Key in run.json: the name of the computer on which the run was started or last resumed."""
PLANNED: Final = "planned"
"""Key in run.json: the planned work of each component at the first start, as `PlannedWork.as_dict`."""
SOLVES: Final = "solves"
"""Key in the facts about a process in run.json: the problems that the process solves."""
METADATA: Final = "metadata"
"""Key in run.json: facts about sample, people and microscope for every file, by name."""
NEVER_SHOWN: Final = "never_shown"
"""Key in run.json: what the controller never shows of a measurement, with the reasons."""
LOST_WITHOUT: Final = "lost_without"
"""Key in run.json: what the controller can't do with these settings, each with its remedy, as sentences."""
LATEST_LINK: Final = "latest"
"""Link in the folder of all runs, to the newest."""
LATEST_FILE: Final = "latest.txt"
"""File with the name of the newest run, where links are impossible."""


def read_run_json(folder: Path) -> Plain:
    """Return the content of run.json in the folder of a run.

    Raises:
        FileError: the file is missing, unreadable, or not a JSON object.
    """
    file = folder / RUN_FILE
    try:
        facts = from_json(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileError(f"can't be read: {error}", where=str(file)) from error
    if not isinstance(facts, dict):
        raise FileError("is not what a run leaves", where=str(file))
    return facts


def run_json_or_empty(folder: Path) -> Plain:
    """Return the content of run.json; empty if the file can't be read."""
    try:
        return read_run_json(folder)
    except FileError:
        return {}


def latest_run(runs: Path) -> Path | None:
    """Return the folder of the newest run in the folder of all runs; None if there is none."""
    link, file = runs / LATEST_LINK, runs / LATEST_FILE
    if link.is_dir():
        return runs / link.resolve().name
    return runs / file.read_text(encoding="utf-8").strip() if file.is_file() else None


def experiment_name(folder: Path, otherwise: str = "") -> str:
    """Return the name of the experiment of a run folder; `otherwise` if unknown."""
    return str(run_json_or_empty(folder).get("name") or otherwise)
