"""Overlay that makes a translator trace its traffic with the controller."""

from __future__ import annotations

from pathlib import Path

from afspm.experiment.component_settings import default_of
from afspm.experiment.resolved_experiment import ResolvedExperiment
from afspm.model import Role


def trace_overlay(experiment: ResolvedExperiment, folder: Path) -> Path | None:
    """Write an overlay into `folder` that switches the trace of the first translator with the setting `trace` on.

    Returns:
        The path of the overlay; None if no translator has the setting.
    """
    for translator in experiment.with_role(Role.TRANSLATOR):
        if translator.component is not None and default_of(translator.component, "trace") is not None:
            overlay = folder / "trace.toml"
            overlay.write_text(f"[{translator.name}]\ntrace = true\n", encoding="utf-8")
            return overlay
    return None
