"""Guests: makers, drift, web and bridges. Each joins by entry points; nothing outside this folder imports it.

A guest brings everything in its own folder: code, parameters, documentation; its tests are in `tests/plugins`. What it
offers stands in `[project.entry-points]` of `pyproject.toml`, in the groups that `basics/entry_points.py` lists; a
stranger's package joins in the same way.
"""
