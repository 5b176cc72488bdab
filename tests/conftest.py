"""For all tests."""

from __future__ import annotations

from hypothesis import settings

# how long one example takes says more about how busy the computer is than about us
settings.register_profile("afspm", deadline=None)
settings.load_profile("afspm")
