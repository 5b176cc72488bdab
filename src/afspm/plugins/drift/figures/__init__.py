"""Figures of drift, drawn from plain data, so that runs, recorded files and studies share them.

Matplotlib is loaded with the modules, not with this package.
"""

from __future__ import annotations
