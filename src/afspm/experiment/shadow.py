"""Overlay that turns an experiment into a shadow: a run that only watches a person's work."""

from __future__ import annotations

from pathlib import Path

from afspm.basics.errors import ConfigError
from afspm.experiment.resolved_experiment import ResolvedExperiment
from afspm.model import Role


def shadow_overlay(experiment: ResolvedExperiment, folder: Path) -> Path:
    """Write an overlay into `folder` with the shadows of the translators, and a scheduler that sends nothing.

    Raises:
        ConfigError: no translator, or one without a shadow.
    """
    translators = experiment.with_role(Role.TRANSLATOR)
    if not translators:
        raise ConfigError("there is no translator here, so no controller to watch", hint="name its class")
    lines = ["[control]", "shadow = true"]
    for translator in translators:
        shadow = getattr(translator.component, "shadow", "")
        if not shadow:
            problem = f"{translator.part.class_path or translator.name} has no shadow, a driver that only reads"
            raise ConfigError(problem, where=f"[{translator.name}]", hint="see docs/how-to/shadow.md")
        lines += [f"[{translator.name}]", f'class = "{shadow}"', "trace = true"]
    overlay = folder / "shadow.toml"
    overlay.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return overlay
