"""The notifier, which is part of an experiment whose file says in [notify] who is to be told of what."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from afspm.components.notifications import END, OCCASIONS, Targets, address
from afspm.errors import ConfigError
from afspm.experiment.parts import ExperimentPart
from afspm.model import Role

if TYPE_CHECKING:
    from afspm.experiment.resolution import ResolvedExperiment
    from afspm.experiment.sections import NotifySection

NAME = "notifier"
CLASS = "Notifier"
SECTION = "notify"


def notifies(component: Any) -> bool:
    """Whether a class tells people, as it says by an attribute."""
    return getattr(component, "notifies", False) is True


def implied(resolved: ResolvedExperiment, section: NotifySection) -> ExperimentPart | None:
    """The notifier as [notify] wants it; None if nobody is to be told of what happens during the experiment."""
    told = (set(OCCASIONS) - {END}) & set(section.on)
    there_is_one = any(notifies(component) for component in resolved.classes.values())
    if not (section.command or section.webhook) or not told or there_is_one or not resolved.with_role(Role.SCHEDULER):
        return None
    wanted = targets(section, resolved.document.folders[0])
    settings: dict[str, Any] = {"program": list(wanted.command)} if wanted.command else {}
    settings |= {"webhook": wanted.webhook} if wanted.webhook else {}
    settings |= {"on": list(section.on), "unsolved_after": section.unsolved_after, "folder": wanted.folder}
    return ExperimentPart(
        resolved.parts.free_name(NAME), CLASS, (), settings, {}, resolved.document.place(SECTION), implied=True
    )


def targets(section: NotifySection, folder: Path) -> Targets:
    """Who is told. "python" as the program means the one that runs us."""
    command = section.command
    if command[:1] == ("python",):
        command = (sys.executable, *command[1:])
    return Targets(command, section.webhook, str(folder))


def check(resolved: ResolvedExperiment) -> None:
    """Somebody is to be told, and can be."""
    section, findings, document = resolved.notify, resolved.findings, resolved.document
    place = document.place(SECTION)
    if SECTION in resolved.parts.sections and not (section.command or section.webhook):
        findings.error("[notify] nobody is told of anything", place, "give a `command` or a `webhook`")
    if section.command and not is_program(section.command[0], document.folders[0]):
        findings.error(
            f"[notify] there is no program {section.command[0]!r}",
            document.place(SECTION, "command"),
            "give its path, or install it",
        )
    if section.webhook:
        try:
            address(section.webhook)
        except ConfigError as error:
            # the environment may be that of another computer, where the scheduler is started
            tell = findings.warning if section.webhook.startswith("$") else findings.error
            tell(f"[notify] webhook: {error.what}", document.place(SECTION, "webhook"), error.hint)


def is_program(name: str, folder: Path) -> bool:
    """Whether a command may begin with this: "python", which is ours, a program that is found, a file in a folder."""
    return name == "python" or shutil.which(name) is not None or (folder / name).is_file()
