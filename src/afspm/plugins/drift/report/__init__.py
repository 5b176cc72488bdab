"""Figures, tables and commands about drift, for runs and recorded files.

Matplotlib is loaded with the modules that draw, not with this package.
"""

from __future__ import annotations
