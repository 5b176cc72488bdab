"""Skips what needs network namespaces, aloud, and gives each test hosts of its own: `make test-hosts`."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

if sys.platform == "linux":
    from tests.system.hosts.hosts_lab import HostsLab


def _lacking() -> str:
    """Return what this computer lacks for hosts of our own; empty: nothing."""
    if sys.platform != "linux":
        return "Linux"
    if os.geteuid() != 0:
        return "root"
    if not os.access("/dev/net/tun", os.W_OK):
        return "/dev/net/tun"
    return ", ".join(tool for tool in ("unshare", "nsenter", "mount", "ip", "cc") if shutil.which(tool) is None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip all of them where hosts can't be made."""
    if lacking := _lacking():
        for item in items:
            if Path(__file__).parent in item.path.parents:
                item.add_marker(pytest.mark.skip(reason=f"several hosts on one computer need {lacking}"))


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Callable[..., HostsLab]]:
    """`lab(scans=4)`: hosts, which end with the test."""
    made: list[HostsLab] = []

    def make(**settings: Any) -> HostsLab:
        made.append(HostsLab(tmp_path, **settings))
        return made[-1]

    yield make
    for one in made:
        one.close()
