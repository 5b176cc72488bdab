"""A recorded run in the formats of others: `afspm export`."""

from __future__ import annotations

from afspm.record.export.exporting import FORMATS, chosen, export

__all__ = ["FORMATS", "chosen", "export"]
