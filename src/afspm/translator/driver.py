"""`Driver`: what one writes for a new controller. Everything else is done by the `Translator`, once for all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.translator.driver_base import DriverBase

if TYPE_CHECKING:
    from afspm.transport.process.context import ProcessContext


class Driver(DriverBase):
    __doc__ = DriverBase.__doc__

    def run_process(self, context: ProcessContext) -> int:
        """Be the translator of an experiment (what the host calls)."""
        from afspm.translator.translator import run_translator

        return run_translator(self, context)
