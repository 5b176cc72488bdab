"""Whether experiment files still say what a run was begun with, for who would resume it by their name."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from afspm.errors import ConfigError
from afspm.experiment import Experiment, load
from afspm.record.run_lock import quoted, resume_command


def refuse_edited(files: Sequence[Path], begun: Experiment, folder: Path) -> None:
    """Refuse to go on with the run in `folder` if that would not be by the files as they are: limits, for instance.

    Args:
        files: those that it was begun with.
        begun: what they said then.

    Raises:
        ConfigError: they say something else now.
    """
    differs = differing(_whole(begun), _whole(load(*files)))
    if differs:
        named = " ".join(map(quoted, files))
        raise ConfigError(
            f"was edited since this run was begun, which goes on as it was: {'; '.join(differs)}",
            where=", ".join(map(str, files)),
            hint=f"{resume_command(folder)} goes on without what was edited, "
            f"`afspm run {named}` begins a new run with it",
        )


def _whole(experiment: Experiment) -> dict[str, Any]:
    """What is in force, defaults too, whoever wrote it down."""
    experiment.resolved  # noqa: B018  (adds what the file leaves open)
    return tomllib.loads(experiment.expanded(secrets=False))


def differing(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Where two experiments differ: each section with its keys."""
    found = []
    for name in {**before, **now}:
        then, later = before.get(name), now.get(name)
        if then == later:
            continue
        if isinstance(then, dict) and isinstance(later, dict):
            keys = [key for key in {**then, **later} if then.get(key) != later.get(key)]
            found.append(f"[{name}] {', '.join(keys)}")
        elif isinstance(then, dict) or isinstance(later, dict):
            found.append(f"[{name}] is {'new' if then is None else 'gone'}")
        else:
            found.append(name)
    return found
