"""Readers of the controllers' files. Each format is a module; libraries are imported only when needed.

    from afspm.storage.formats import read
    content = read("scan0001.ibw")
    content.scans[0].values      # [y, x], both ascending

A reader is a function from a path and a time zone to a `FileContent`. Packages declare readers by the suffixes of their
files (`afspm.basics.entry_points`).
"""

from __future__ import annotations

from afspm.storage.formats.content import FileContent, OtherFormat
from afspm.storage.formats.reading import read, suffixes

__all__ = ["FileContent", "OtherFormat", "read", "suffixes"]
