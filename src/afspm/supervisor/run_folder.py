"""The folder that a run leaves behind: experiment file, log, and everything measured."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import FileError
from afspm.record.run_json import EXPERIMENT_FILE, LATEST_FILE, LATEST_LINK, RUN_FILE, STATE_DIR
from afspm.storage.atomic import replace_file
from afspm.storage.disk import sync_folder

LOG_FILE = "log.txt"
MOST_RUNS_A_SECOND = 1000


def create(runs: Path, experiment: str, started: datetime) -> Path:
    """Make the run folder `runs/<experiment>-<time>/` and return its absolute path; `runs/latest` then leads to it.

    Raises:
        FileError: the folder can't be made.
    """
    name = re.sub(r"[^\w.-]+", "-", experiment).strip("-.") or "experiment"
    stamp = f"{name}-{started:%Y%m%d-%H%M%S}"
    try:
        runs.mkdir(parents=True, exist_ok=True)
        folder = _new_folder(runs.resolve(), stamp)
        (folder / STATE_DIR).mkdir()
        sync_folder(folder)
        sync_folder(folder.parent)  # without its name a power cut may take the folder with all that is synced in it
        _point_to(runs, folder.name)
    except OSError as error:
        raise FileError(
            f"no folder for the run can be made: {error.strerror or error}",
            where=str(runs),
            hint="choose another with --runs",
        ) from error
    return folder


def now() -> datetime:
    """Return real time, in this computer's time zone."""
    return datetime.fromtimestamp(ExperimentClock.real().now_s()).astimezone()


def write_run(folder: Path, facts: Mapping[str, object]) -> None:
    """Write run.json, from which `afspm.connect` finds the running experiment."""
    _replace(folder / RUN_FILE, json.dumps(facts, indent=2, ensure_ascii=False) + "\n")


def write_experiment(folder: Path, text: str) -> None:
    """Write the expanded experiment file: one file, with every default filled in."""
    _replace(folder / EXPERIMENT_FILE, text)


def _new_folder(runs: Path, stamp: str) -> Path:
    for number in range(1, MOST_RUNS_A_SECOND):  # several runs may start in the same second
        folder = runs / (stamp if number == 1 else f"{stamp}-{number}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise FileExistsError(f"{stamp} is there {MOST_RUNS_A_SECOND} times")


def _point_to(runs: Path, name: str) -> None:
    aside = runs / f".{LATEST_LINK}-{name}"
    try:
        aside.symlink_to(name, target_is_directory=True)
        aside.replace(runs / LATEST_LINK)
    except OSError:  # on Windows only some users may create links
        aside.unlink(missing_ok=True)
        _replace(runs / LATEST_FILE, name + "\n")


def _replace(file: Path, text: str) -> None:
    replace_file(file, [text.encode()])
