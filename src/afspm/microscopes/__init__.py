"""Microscopes: the translator, which is the same for all, and a folder for each that can be translated to.

To add one: write a `Driver` and its table of parameters.
"""

from __future__ import annotations

from afspm.translator.driver import ControllerLost, Driver, action
from afspm.translator.parameters import ParameterSpec, ParameterTable, Value

__all__ = ["ControllerLost", "Driver", "ParameterSpec", "ParameterTable", "Value", "action"]
