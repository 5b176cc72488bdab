"""Grids of spectra. How long one takes is emulated, not what is saved of it."""

from __future__ import annotations

from typing import Final

from afspm.emulators.nanonis.dispatch import Answer, FunctionRefused, answers, chosen
from afspm.emulators.nanonis.panel import NanonisState

_EXPERIMENTS: Final = {"Bias Spectroscopy": "IV", "Z Spectroscopy": "force"}
_PATTERNS: Final = ("Grid", "Line", "Cloud")
_BUSY: Final = "pattern"


@answers("Pattern.PropsSet")
def _props_set(
    panel: NanonisState, experiment: str, base_name: str, path: str, delay_s: float, save_channels: int
) -> Answer:
    before = panel.registers.get("Pattern.Props")
    if experiment and experiment not in _EXPERIMENTS:
        raise FunctionRefused(f"there is no experiment {experiment!r}")
    panel.registers.put(
        "Pattern.Props", experiment or before[0], panel.name(base_name) or before[1], path, delay_s, save_channels
    )
    return ()


@answers("Pattern.PropsGet")
def _props_get(panel: NanonisState) -> Answer:
    return list(_EXPERIMENTS), *panel.registers.get("Pattern.Props")[1:]


@answers("Pattern.ExpOpen")
def _open(panel: NanonisState) -> Answer:
    panel.opened.add("Pattern")
    return ()


@answers("Pattern.ExpStart")
def _start(panel: NanonisState, pattern: int) -> Answer:
    if "Pattern" not in panel.opened:
        raise FunctionRefused("the experiment is not open")
    active = chosen(pattern, (*panel.registers.get("Pattern.Active"), _PATTERNS[0])[0], *_PATTERNS)
    first, second, *_ = (*panel.registers.get(f"Pattern.{active}"), 1, 1)
    points = first * second if active == "Grid" else first
    if points < 1:
        raise FunctionRefused(f"a pattern of {points} points")
    kind = _EXPERIMENTS[panel.registers.get("Pattern.Props")[0]]
    panel.rig.occupy(_BUSY, points * panel.rig.world.spectrum_s(kind))
    panel.registers.put("Pattern.Active", active)
    return ()


@answers("Pattern.ExpStop")
def _stop(panel: NanonisState) -> Answer:
    panel.rig.stop(_BUSY)
    return ()


@answers("Pattern.ExpStatusGet")
def _status(panel: NanonisState) -> Answer:
    return (int(panel.rig.doing(panel.clock.now_s()) == _BUSY),)
