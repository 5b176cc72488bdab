"""The dashboard: a page on which viewers watch an experiment, and signed-in persons steer it."""

from __future__ import annotations

from afspm.plugins.web.dashboard.dashboard import Dashboard

__all__ = ["Dashboard"]
