"""Ready-made components. Each is loaded only when it is asked for, so that a process starts with what it needs."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afspm.components.drift_pictures import DriftPictures as DriftPictures
    from afspm.components.drift_table import DriftTable as DriftTable
    from afspm.components.feedback_analysis import FeedbackAnalysis as FeedbackAnalysis
    from afspm.components.feedback_tuner import FeedbackTuner as FeedbackTuner
    from afspm.components.log_collector import LogCollector as LogCollector
    from afspm.components.metadata import Metadata as Metadata
    from afspm.components.night_picture import NightPicture as NightPicture
    from afspm.components.notifier import Notifier as Notifier
    from afspm.components.planned_scans import RegionGrid as RegionGrid
    from afspm.components.planned_scans import ScanList as ScanList
    from afspm.components.planned_scans import ScanSeries as ScanSeries
    from afspm.components.recorder import Recorder as Recorder
    from afspm.components.rescanner import Rescanner as Rescanner
    from afspm.components.spectroscopy_grid import SpectroscopyGrid as SpectroscopyGrid
    from afspm.components.survey import Survey as Survey
    from afspm.components.tip_classifier import TipClassifier as TipClassifier
    from afspm.components.tip_corrector import TipCorrector as TipCorrector

_MODULES = {
    "DriftPictures": "drift_pictures",
    "DriftTable": "drift_table",
    "FeedbackAnalysis": "feedback_analysis",
    "FeedbackTuner": "feedback_tuner",
    "LogCollector": "log_collector",
    "Metadata": "metadata",
    "NightPicture": "night_picture",
    "Notifier": "notifier",
    "Recorder": "recorder",
    "RegionGrid": "planned_scans",
    "Rescanner": "rescanner",
    "ScanList": "planned_scans",
    "ScanSeries": "planned_scans",
    "SpectroscopyGrid": "spectroscopy_grid",
    "Survey": "survey",
    "TipClassifier": "tip_classifier",
    "TipCorrector": "tip_corrector",
}

__all__ = list(_MODULES)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
