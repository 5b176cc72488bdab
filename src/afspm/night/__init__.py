"""A run read and reduced: `afspm.open_run`, tables of scans and spectra, the overview of its packets, all runs.

**Theory of operation.** A night is read from its record, or reduced from packets while it goes on. Nothing here draws.

    comes in      the record of a run, or its packets
    state         none on disk; an `Overview` keeps summaries in memory, bounded
    goes out      `Run`, its tables and packets, `Overview`, the catalogue of runs
    always holds  a repeated or older packet changes nothing; a damaged row or file is named and hides no other
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.night.overview import ScanSummary
    from afspm.night.packets import RecordPlayback
    from afspm.night.tables import ScanRow, SpectrumRow

if TYPE_CHECKING:  # the page shows a night while it goes on
    from afspm.night.expected_end import Plans, plans_of
    from afspm.night.overview import OVER, ROUTINE, DriftPoint, FoundPlace, Overview, RunningScan, SpectrumSummary
    from afspm.night.reading_curves import instrument_curves
    from afspm.night.timeline import Span, Timeline

__all__ = [
    "OVER",
    "ROUTINE",
    "DriftPoint",
    "FoundPlace",
    "Overview",
    "Plans",
    "RecordPlayback",
    "RunningScan",
    "ScanRow",
    "ScanSummary",
    "Span",
    "SpectrumRow",
    "SpectrumSummary",
    "Timeline",
    "instrument_curves",
    "plans_of",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.night.expected_end": "Plans plans_of",
            "afspm.night.overview": (
                "ScanSummary OVER ROUTINE DriftPoint FoundPlace Overview RunningScan SpectrumSummary"
            ),
            "afspm.night.packets": "RecordPlayback",
            "afspm.night.reading_curves": "instrument_curves",
            "afspm.night.tables": "ScanRow SpectrumRow",
            "afspm.night.timeline": "Span Timeline",
        },
    )
