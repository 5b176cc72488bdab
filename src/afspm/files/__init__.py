"""Readers of the files that controllers write. Each format is a module; libraries are imported only when needed.

    from afspm.files import read
    content = read("scan0001.ibw")
    content.scans[0].values      # [y, x], both ascending

A reader is a function from a path and a time zone to a `FileContent`; packages declare readers by the suffix of their
files (`afspm.entry_points`).
"""

from __future__ import annotations

from afspm.files.content import FileContent, OtherFormat
from afspm.files.reading import read, suffixes

__all__ = ["FileContent", "OtherFormat", "read", "suffixes"]
