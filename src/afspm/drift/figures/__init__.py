"""What drift looks like: one module a figure, each with a function `draw` that returns a matplotlib Figure.

They take plain data (a `DriftRecord`, scans, matches), so that runs, recorded files and studies share them. They need
matplotlib (`pip install "afspm[plot]"`), which is loaded with the modules, not with this package.
"""

from __future__ import annotations
