"""Overlay that turns an experiment into a shadow: a run that only watches a person's work."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError
from afspm.experiment import class_loader
from afspm.experiment.findings import nearest
from afspm.experiment.resolved_experiment import ResolvedExperiment
from afspm.model import Role

if TYPE_CHECKING:
    from afspm.translator.driver_base import DriverBase

_DETECTORS = """
[scheduler]
component = true
class = "DriftCompensatedScheduler"
drift = { correct = false } # the person's frames stay as they were set

[classifier]
component = true
class = "TipClassifier"
"""
_OF_LINES = """
[lines]
component = true
class = "LineWatch"
"""


def driver_of(maker: str) -> tuple[str, type[DriverBase]]:
    """Return the name and class of a maker's driver by its short name, in any case: "nanonis".

    Raises:
        ConfigError: there is no such driver.
    """
    drivers = {name.lower(): name for name in entry_points.names(entry_points.DRIVERS)}
    if maker.lower() not in drivers:
        raise ConfigError(f"there is no driver {maker!r}", where="--on", hint=nearest(maker.lower(), drivers))
    name = drivers[maker.lower()]
    driver: type[DriverBase] = entry_points.load(entry_points.DRIVERS, name)
    return name, driver


def shadow_file(maker: str, folder: Path) -> Path:
    """Write an experiment into `folder`: all detectors that need no settings, on the microscope of a maker.

    Raises:
        ConfigError: there is no such driver.
    """
    from afspm.translator.driver_base import DriverBase

    name, driver = driver_of(maker)
    watcher: type[DriverBase] = class_loader.load(driver.shadow) if driver.shadow else driver  # refused by the overlay
    has_lines = watcher.lines is not DriverBase.lines
    lines = ["[microscope]", "component = true", f'class = "{name}"', *(['live_lines_s = "1 s"'] if has_lines else [])]
    file = folder / f"{maker.lower()}_shadow.toml"
    file.write_text("\n".join(lines) + "\n" + _DETECTORS + (_OF_LINES if has_lines else ""), encoding="utf-8")
    return file


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
