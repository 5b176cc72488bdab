"""Tests with files of real microscopes, which a clone does not have: `make real-data`.

They are collected only where this folder is named, and fail, rather than skip, where the files are not there.
"""

from __future__ import annotations

import os

import pytest
from benchmarks.data_folder import DATA


def pytest_collection_modifyitems() -> None:
    """Stop before the first test if the folder is not there."""
    if not DATA.is_dir():
        pytest.exit(
            f"{DATA} is no folder: set AFSPM_DATA=/path/to/data to the folder with the files of real microscopes that "
            "tests/real_data/record.json lists",
            returncode=0 if os.environ.get("AFSPM_LACKING") == "passes" else pytest.ExitCode.USAGE_ERROR,
        )
