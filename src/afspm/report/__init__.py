"""The views of a recorded night: report, exports, films, figures, comparisons, the table of a shadow.

**Theory of operation.** Each view reads a night once, and writes its file whole or not at all.

    comes in      a run, as `night` reads it
    state         none
    goes out      pages, pictures and files of other programs, for people and for their tools
    always holds  a simulated night says so; a scan that can't be read is named, and the others are shown
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.report.markup import document, section, table

if TYPE_CHECKING:  # drift completes the report, and compares nights
    from afspm.report.comparison import compare
    from afspm.report.comparison_page import rows_that_differ
    from afspm.report.comparison_page import write as write_comparison
    from afspm.report.pictures import OFFSET, is_ours, topography

if TYPE_CHECKING:  # the page writes and shows it
    from afspm.report import shadow as shadow_report
    from afspm.report.night_report import REPORT_FILE
    from afspm.report.night_report import write as write_report

__all__ = [
    "OFFSET",
    "REPORT_FILE",
    "compare",
    "document",
    "is_ours",
    "rows_that_differ",
    "section",
    "shadow_report",
    "table",
    "topography",
    "write_comparison",
    "write_report",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.report.comparison": "compare",
            "afspm.report.comparison_page": "rows_that_differ",
            "afspm.report.markup": "document section table",
            "afspm.report.night_report": "REPORT_FILE",
            "afspm.report.pictures": "OFFSET is_ours topography",
        },
        shadow_report="afspm.report.shadow",
        write_comparison="afspm.report.comparison_page.write",
        write_report="afspm.report.night_report.write",
    )
