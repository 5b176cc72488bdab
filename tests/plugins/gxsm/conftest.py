"""Fixtures for tests of GXSM."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from temporary_folder import use_temporary_folder
from tests.plugins.gxsm.gxsm_bench import Bench
from tests.plugins.vendor_bench import benches


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    yield from benches(Bench, tmp_path)


def is_real(request: pytest.FixtureRequest) -> bool:
    """Return True for a test with a real GXSM, which has its own secret and its own lock file."""
    return str(request.node.name).endswith("[real]")


@pytest.fixture(autouse=True)
def own_home(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Give the bridge a secret in the test's own home folder."""
    if is_real(request):
        return
    home = tmp_path_factory.mktemp("home")
    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(home))


@pytest.fixture(autouse=True)
def own_lock(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give each test its own lock file: callers of all GXSMs on one computer share one."""
    if is_real(request):
        return
    use_temporary_folder(tmp_path, monkeypatch)
