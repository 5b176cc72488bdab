"""For the tests of packages: fixtures of afspm's own tests."""

from __future__ import annotations

from tests.system.experiment.conftest import afspm_run

__all__ = ["afspm_run"]
