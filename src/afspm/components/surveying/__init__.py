"""Surveys: a wide scan, the targets found in it, and what was measured at each; for components and scripts alike."""

from __future__ import annotations

from afspm.components.surveying.record import Outcome, SurveyRecord, Visit
from afspm.components.surveying.targets import Target, find_particles, lowest_beside, nearest

__all__ = ["Outcome", "SurveyRecord", "Target", "Visit", "find_particles", "lowest_beside", "nearest"]
