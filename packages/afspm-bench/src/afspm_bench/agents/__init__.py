"""Agents included with the bench: baselines, and planted agents with one defect each."""

from __future__ import annotations

from typing import Final

_HERE: Final = "afspm_bench.agents"
SHIPPED: Final = {
    "oracle": f"{_HERE}.oracle:Oracle",
    "script": f"{_HERE}.script:Script",
    "random": f"{_HERE}.baselines:Random",
    "idle": f"{_HERE}.baselines:Idle",
    "liar": f"{_HERE}.planted:Liar",
    "reckless": f"{_HERE}.planted:Reckless",
    "sleepwalker": f"{_HERE}.planted:Sleepwalker",
    "obedient": f"{_HERE}.planted:Obedient",
    "replayer": f"{_HERE}.planted:ReplayingAgent",
    "optimist": f"{_HERE}.planted:Optimist",
}
"""Class of each shipped agent, by name."""
HOME: Final = {
    "reckless": "trouble",
    "sleepwalker": "operate",
    "obedient": "restraint",
    "replayer": "night",
    "optimist": "measure",
}
"""Family in which each planted agent must fail; it has to pass the other families."""
SEES_TRUTH: Final = frozenset({"oracle"})
