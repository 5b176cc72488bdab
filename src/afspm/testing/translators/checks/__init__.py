"""The checks: importing this marks them, in this order."""

from __future__ import annotations

from importlib import import_module

ORDER = (
    "published",
    "cancelling",
    "scans",
    "frames",
    "picture",
    "feedback",
    "probe",
    "spectra",
    "parameters",
    "refusals",
    "busy",
)

for _name in ORDER:
    import_module(f"{__name__}.{_name}")
