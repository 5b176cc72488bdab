"""The experiment in the browser: every viewer sees it, and signed-in viewers steer it."""

from __future__ import annotations

from afspm.plugins.web.dashboard.dashboard import Dashboard

__all__ = ["Dashboard"]
