"""Microscopes: the translator, which is the same for all, and a folder for each that can be translated to.

To add one: write a `Microscope` and its table of parameters.
"""

from __future__ import annotations

from afspm.microscopes.microscope import ControllerLost, Microscope, action
from afspm.microscopes.parameters import ParameterSpec, ParameterTable, Value

__all__ = ["ControllerLost", "Microscope", "ParameterSpec", "ParameterTable", "Value", "action"]
