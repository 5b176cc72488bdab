"""The dashboard: a page on which viewers watch an experiment, and signed-in persons steer it.

It is a page of afspm's own: a Grafana or a notebook server would be one more thing to install, and neither requests
control from a scheduler.
"""

from __future__ import annotations

from afspm.plugins.web.dashboard.dashboard import Dashboard

__all__ = ["Dashboard"]
