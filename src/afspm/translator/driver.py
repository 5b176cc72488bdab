"""`Driver`: the base class for drivers of new controllers. The `Translator` does everything else."""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.translator.driver_base import DriverBase

if TYPE_CHECKING:
    from afspm.transport.process.context import ProcessContext


class Driver(DriverBase):
    __doc__ = DriverBase.__doc__

    def run_process(self, context: ProcessContext) -> int:
        """Run the translator of an experiment. Called by the host of processes."""
        from afspm.translator.translator import run_translator

        return run_translator(self, context)
