"""How long a test waits for what must come."""

from __future__ import annotations

from typing import Final

DEADLINE_S: Final = 480.0
"""Real seconds: enough for a computer ten times slower that has other work too. No verdict depends on speed.

The limit of one test (pyproject.toml) ends a hang; this is shorter, so that the message says what did not come.
"""
