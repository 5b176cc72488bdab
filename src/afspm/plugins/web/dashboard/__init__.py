"""The experiment in the browser: seen by everybody, steered by those who may."""

from __future__ import annotations

from afspm.plugins.web.dashboard.dashboard import Dashboard

__all__ = ["Dashboard"]
