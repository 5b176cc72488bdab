"""The translator: the process between the scheduler and one microscope, the same for all, around a vendor's `Driver`.

To add a microscope: write a `Driver` and its table of parameters (docs/how-to/write-a-driver.md).
"""

from __future__ import annotations

from afspm.translator.driver import ControllerLost, Driver, action
from afspm.translator.parameters import ParameterSpec, ParameterTable, Value

__all__ = ["ControllerLost", "Driver", "ParameterSpec", "ParameterTable", "Value", "action"]
