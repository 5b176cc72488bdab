"""The morning report: `report.html`, one file that needs no other, and figures beside it, of a recorded run."""

from __future__ import annotations

from afspm.record.report.writing import REPORT_FILE, write

__all__ = ["REPORT_FILE", "write"]
