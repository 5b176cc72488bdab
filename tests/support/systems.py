"""The system that the tests run on, where a test goes by it."""

from __future__ import annotations

import ctypes
import sys

import pytest

WINE = sys.platform == "win32" and hasattr(ctypes.WinDLL("ntdll"), "wine_get_version")
"""A Windows Python runs the tests, but Windows' own functions are those of Wine."""


def not_on_wine(reason: str) -> pytest.MarkDecorator:
    """Skip a test under Wine, for a reason that does not hold on a real Windows."""
    return pytest.mark.skipif(WINE, reason=f"Wine: {reason}")
