"""The figures of drift, drawn from plain data, so that runs, recorded files and studies share them.

They need matplotlib (`pip install "afspm[plot]"`), which is loaded with the modules, not with this package.
"""

from __future__ import annotations
