"""Fixtures for the tests of all makers."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

# vendor_bench is shared by the folders of the vendors
sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[2]))  # `benchmarks` has the fuzzers, which serve here too
pytest.register_assert_rewrite("vendor_bench")
