"""The experiment in the browser: shown to every viewer, steered by viewers who have signed in."""

from __future__ import annotations

from afspm.plugins.web.dashboard.dashboard import Dashboard

__all__ = ["Dashboard"]
