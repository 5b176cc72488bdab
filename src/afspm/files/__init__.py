"""Readers of the files that controllers write. Each format is a module; libraries are imported only when needed.

    from afspm.files import read
    content = read("scan0001.ibw")
    content.scans[0].values      # [y, x], both ascending

A format is a function from a path and a time zone to a `FileContent`; `FORMATS` has them by the suffix.
"""

from __future__ import annotations

from afspm.files.content import FileContent
from afspm.files.reading import FORMATS, read

__all__ = ["FORMATS", "FileContent", "read"]
