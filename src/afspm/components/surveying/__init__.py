"""Surveys, for components and scripts: a wide scan, the targets found in it, and the measurements at each target."""

from __future__ import annotations

from afspm.components.surveying.record import Outcome, SurveyRecord, Visit
from afspm.components.surveying.targets import Target, find_particles, lowest_beside, nearest

__all__ = ["Outcome", "SurveyRecord", "Target", "Visit", "find_particles", "lowest_beside", "nearest"]
