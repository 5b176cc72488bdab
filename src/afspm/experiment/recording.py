"""The recorder, which is part of every experiment whose file does not say otherwise."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

from afspm.experiment.parts import ExperimentPart
from afspm.model import Role

if TYPE_CHECKING:
    from afspm.experiment.resolution import ResolvedExperiment
    from afspm.experiment.sections import RecordSection

NAME = "recorder"
CLASS = "Recorder"


def records(component: Any) -> bool:
    """Whether a class keeps the record of a run, as it says by an attribute."""
    return getattr(component, "records", False) is True


def implied(resolved: ResolvedExperiment, section: RecordSection) -> ExperimentPart | None:
    """The recorder as [record] wants it; None if it wants none, or the file has one, or there is no scheduler."""
    there_is_one = any(records(component) for component in resolved.classes.values())
    if not section.on or there_is_one or not resolved.with_role(Role.SCHEDULER):
        return None
    place = resolved.document.place("record")
    scans = section.scans
    if scans and importlib.util.find_spec("h5py") is None:
        scans = False
        resolved.findings.warning(
            "scans and spectra are not recorded: h5py is not installed",
            place,
            'pip install "afspm[record]"; or say [record] scans = false',
        )
    settings = {} if scans else {"scans": False}
    return ExperimentPart(resolved.parts.free_name(NAME), CLASS, (), settings, {}, place, implied=True)
