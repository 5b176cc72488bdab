"""Components of every experiment that its file does not list: the recorder, and the notifier of [notify]."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.basics.errors import ConfigError
from afspm.components.notifications import END, OCCASIONS, Targets, address
from afspm.experiment.parts import ExperimentPart
from afspm.experiment.toml_lines import Settings
from afspm.model import Role

if TYPE_CHECKING:
    from afspm.experiment.resolved_experiment import ResolvedExperiment
    from afspm.experiment.sections import NotifySection

RECORDER, NOTIFIER = "recorder", "notifier"
RECORDS, NOTIFIES = "records", "notifies"
"""Class attributes that mark a recorder or a notifier."""
NO_PROGRAM = "give its path, or install it; a file of yours must be executable (chmod +x)"


def complete(resolved: ResolvedExperiment) -> list[ExperimentPart]:
    """Return a recorder and a notifier, each unless it is switched off or in the file; none without a scheduler."""
    return [part for part in (_recorder(resolved), _notifier(resolved)) if part is not None]


def _recorder(resolved: ResolvedExperiment) -> ExperimentPart | None:
    section = resolved.sections.record
    if not section.on or resolved.declaring(RECORDS) or not resolved.with_role(Role.SCHEDULER):
        return None
    return _implied(resolved, RECORDER, {} if section.scans else {"scans": False}, "record")


def _notifier(resolved: ResolvedExperiment) -> ExperimentPart | None:
    section = resolved.sections.notify
    occasions = (set(OCCASIONS) - {END}) & set(section.on)
    is_wanted = section.ping or ((section.command or section.webhook) and occasions)
    if not is_wanted or resolved.declaring(NOTIFIES) or not resolved.with_role(Role.SCHEDULER):
        return None
    wanted = targets(section, resolved.document.folders[0])
    settings: Settings = {"program": list(wanted.command)} if wanted.command else {}
    settings |= {"webhook": wanted.webhook} if wanted.webhook else {}
    settings |= {"on": list(section.on), "unsolved_after": section.unsolved_after, "folder": wanted.folder}
    settings |= {"ping": section.ping, "every": section.every} if section.ping else {}
    return _implied(resolved, NOTIFIER, settings, "notify")


def _implied(resolved: ResolvedExperiment, name: str, settings: Settings, section: str) -> ExperimentPart:
    free_name, place = resolved.parts.free_name(name), resolved.document.place(section)
    return ExperimentPart(free_name, name.capitalize(), (), settings, {}, place, implied=True)


def targets(section: NotifySection, folder: Path) -> Targets:
    """Return the targets of notifications."""
    return Targets(runnable(section.command, folder), section.webhook, str(folder))


def check_notify(resolved: ResolvedExperiment) -> None:
    """Check that [notify] has a target, its program exists, and its webhook is a valid address."""
    section = resolved.sections.notify
    if "notify" in resolved.parts.sections and not (section.command or section.webhook or section.ping):
        resolved.document.error("[notify] has no recipient", "notify", hint="give a `command`, a `webhook` or a `ping`")
    if section.every <= 0.0:
        resolved.document.error("[notify] every is not above zero", "notify", "every", hint='as in "5 min"')
    if section.command and not is_program(section.command[0], resolved.document.folders[0]):
        what = f"[notify] there is no program {section.command[0]!r}"
        resolved.document.error(what, "notify", "command", hint=NO_PROGRAM)
    for key, given in (("webhook", section.webhook), ("ping", section.ping)):
        if not given:
            continue
        try:
            address(given, key=key)
        except ConfigError as error:
            # the scheduler may start on another computer, where the environment has this variable
            report = resolved.document.warning if given.startswith("$") else resolved.document.error
            report(f"[notify] {key}: {error.what}", "notify", key, hint=error.hint)


def runnable(command: tuple[str, ...], folder: Path) -> tuple[str, ...]:
    """Return a command as the system runs it: "python" is the running interpreter, a file in `folder` has its path."""
    if not command:
        return ()
    return (_program(command[0], folder) or command[0], *command[1:])


def is_program(name: str, folder: Path) -> bool:
    """Return whether a program exists: "python", an installed program, or an executable file in `folder`."""
    return _program(name, folder) is not None


def _program(name: str, folder: Path) -> str | None:
    if name == "python":
        return sys.executable
    # the system looks for a bare name in PATH alone, and for a path in the folder of `afspm run`
    is_bare = Path(name).name == name
    return name if is_bare and shutil.which(name) else shutil.which(str(folder / name))
