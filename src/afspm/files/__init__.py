"""Readers of the files that controllers write. Each format is a module; libraries are imported only when needed."""

from __future__ import annotations
