"""`Driver`: the class to write for a new controller. The `Translator` does everything else, once for all makers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.translator.driver_base import DriverBase

if TYPE_CHECKING:
    from afspm.transport.process.context import ProcessContext


class Driver(DriverBase):
    __doc__ = DriverBase.__doc__

    def run_process(self, context: ProcessContext) -> int:
        """Run the translator of an experiment (called by the host of processes)."""
        from afspm.translator.translator import run_translator

        return run_translator(self, context)
