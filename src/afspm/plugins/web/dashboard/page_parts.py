"""Parts of the page that packages add, by entry points of the group `afspm.page_parts`.

| name | the page calls |
| --- | --- |
| `approvals` | `made = part(session)` for each viewer, and `made.show()` at each refresh: approvals, proposals |
| `grant` | `await part(session, agents, region).show()`: a dialog in which a person gives an agent a grant |
"""

from __future__ import annotations

import logging
from typing import Any

from afspm.basics import ConfigError, load_plugin

_GROUP = "afspm.page_parts"
_log = logging.getLogger("afspm.plugins.web.dashboard")


def page_part(name: str) -> Any:
    """Return the class of a part of the page; None if no package adds the part, or its package can't be loaded."""
    try:
        return load_plugin(_GROUP, name)
    except ConfigError as error:  # the page must show everything else
        _log.error("the page goes on without its part %s: %s", name, error)
        return None
