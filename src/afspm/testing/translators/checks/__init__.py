"""The checks: importing this registers them, in this order."""

from __future__ import annotations

from importlib import import_module

for _name in ("frames", "scans", "picture", "feedback", "probe", "spectra", "parameters", "refusals"):
    import_module(f"{__name__}.{_name}")
