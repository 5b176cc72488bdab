"""The Microscope Translator: the process between the scheduler and one microscope, around a maker's `Driver`.

**Theory of operation.** One loop waits for requests and for the next look at the controller.

    comes in      requests of the scheduler; what the driver reads from the controller
    state         what the microscope was last seen to do; answers to recent requests; finished scans not yet published
                  (all on disk)
    goes out      commands to the controller; states, settings, scans and spectra as packets
    always holds  a request is checked as a whole before anything is set; none is executed twice; one scheduler is
                  obeyed (`fencing`); a result is published once, over a kill too (`outbox`); when nobody is left to
                  command, nothing measures on and the tip is safe (`safe_exit`)

A driver (`driver`) reads and sets what its table of parameters names (`parameters`), starts and stops measurements, and
returns their results. It may fail at any time with `ControllerLost`; connecting again is not its business.
"""

from __future__ import annotations

from afspm.translator.driver import Driver
from afspm.translator.driver_base import ControllerLost, action
from afspm.translator.parameters import ParameterSpec, ParameterTable, Value

__all__ = ["ControllerLost", "Driver", "ParameterSpec", "ParameterTable", "Value", "action"]
