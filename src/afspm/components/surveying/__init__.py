"""Surveys, for components and scripts: a wide scan, the targets found in it, and the measurements at each target.

A pixel of a survey is as wide as a small particle, and the lag of the feedback shifts a fast scan. So each target is
found again in its zoom before curves are taken. "Beside" a target is a distance, in the direction where the zoom is
lowest: a fixed offset sooner or later hits a neighbour. Pits, and films without ground between particles, need a
function of the user, since levelling takes the lowest places for ground.
"""

from __future__ import annotations

from afspm.components.surveying.record import Outcome, SurveyRecord, Visit
from afspm.components.surveying.targets import Target, find_particles, lowest_beside, nearest

__all__ = ["Outcome", "SurveyRecord", "Target", "Visit", "find_particles", "lowest_beside", "nearest"]
