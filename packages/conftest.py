"""For the tests of packages: fixtures and plug-ins of afspm's tests."""

from tests.conftest import plain
from tests.system.experiment.conftest import afspm_run

__all__ = ["afspm_run", "plain"]

pytest_plugins = ["must_run", "rotation", "time_per_test"]
