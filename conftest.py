"""For all tests."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import signal
import subprocess
import tempfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from benchmarks.crashes import CrashWatch
from deadlines import DEADLINE_S
from hypothesis import HealthCheck, settings

pytest_plugins = ["must_run", "rotation", "time_per_test"]

# how long one example takes says more about how busy the computer is than about us
any_pace: dict[str, Any] = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("repeatable", **any_pace, derandomize=True, max_examples=60)
# new examples each time, and more of them: AFSPM_EXAMPLES=explore make test
settings.register_profile("explore", **any_pace, max_examples=300)
settings.load_profile(os.environ.get("AFSPM_EXAMPLES", "repeatable"))

# as for a registration in an experiment: on small arrays several threads are slower than one, and take others' cores
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# the key of this user's runs stays apart from the key of the tests' runs; workers of xdist inherit the variable
if "AFSPM_TESTS_STATE" not in os.environ:
    os.environ["AFSPM_TESTS_STATE"] = os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="afspm-tests-")
    atexit.register(shutil.rmtree, os.environ["AFSPM_TESTS_STATE"], ignore_errors=True)

# a shell that runs the tests in the background ignores Ctrl-C for them, and so would everything that they start
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# while tests are collected hardly anything becomes garbage
gc.disable()

SLOW = (
    "tests/installed/",
    "tests/system/",
    "tests/ui/",
    "tests/docs/test_notebook_page.py",
    "tests/docs/test_snippets.py",
)
"""Where the tests of `make test-all` are: they start processes, a browser or whole experiments, and wait for them.

All tests together would hold up a change for 25 to 40 minutes. `make test` finds most mistakes soonest."""
SLOW_MODULES = ("_faults.py",)
"""Of the tests of controllers, those that wait for timeouts in real time."""
QUICK = ("tests/system/scheduler/", "tests/system/supervisor/", "tests/system/process/")
"""Of these, what `make test` runs all the same: the processes that everything else stands on."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import only modules with a slow test for `-m slow`: one of six, and each process that runs tests imports them."""
    if config.option.markexpr != "slow" or collection_path.suffix != ".py":
        return None
    module = collection_path.relative_to(config.rootpath).as_posix()
    return True if not (_is_slow(module) or "mark.slow" in collection_path.read_text(encoding="utf-8")) else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark by folder what `make test` leaves to `make test-all`."""
    for item in items:
        if _is_slow(item.nodeid.partition("::")[0]):
            item.add_marker(pytest.mark.slow)


def _is_slow(module: str) -> bool:
    if module.startswith(SLOW):
        return not module.startswith(QUICK)
    return module.startswith("tests/plugins/") and module.endswith(SLOW_MODULES)


def pytest_collection_finish() -> None:
    """What thousands of tests are made of is there to the end: garbage is not looked for in it again and again.

    Nor as often as Python does: a simulated night makes a great many things and little garbage.
    """
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


@pytest.fixture(autouse=True)
def polls_of_benches(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the benches of one test in thirty poll the microscope at all times, and check the polls that others skip."""
    if zlib.crc32(request.node.nodeid.encode()) % 30 == 0:
        monkeypatch.setenv("AFSPM_BENCH_POLLS", "checked")


@pytest.fixture(autouse=True)
def crashes(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test in which a process of the test, or of a run in its folder, crashes: a supervisor would hide it."""
    watch = CrashWatch()
    _started.clear()
    yield
    found = [crash for process in _started for crash in watch.of(process)]
    if (folder := request.node.funcargs.get("tmp_path")) is not None:
        found += watch.in_logs(folder)
    assert not found or request.node.get_closest_marker("crashes"), found


class _WatchedPopen(subprocess.Popen[Any]):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        _started.append(self)


_started: list[subprocess.Popen[Any]] = []
subprocess.Popen = _WatchedPopen  # type: ignore[misc]


@pytest.fixture
def plain() -> Iterator[Callable[..., Any]]:
    """`plain(zmq.SUB)`: a socket as a peer of version 1 has it, with nothing of ours."""
    context: zmq.Context[Any] = zmq.Context()
    sockets = []  # or those that a test holds no name for are closed

    def socket(kind: int) -> Any:
        made = context.socket(kind)
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.RCVTIMEO, int(DEADLINE_S * 1000))
        sockets.append(made)
        return made

    yield socket
    context.destroy(linger=0)


NO_BROWSER = (
    "no chromium is found: `apt install chromium` (or another way to have it; AFSPM_CHROMIUM=/path says where), "
    "and the package playwright"
)


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A browser without a window: one a process, since Playwright allows no second one in it."""
    sync_api = pytest.importorskip("playwright.sync_api", reason=NO_BROWSER)
    named = os.environ.get("AFSPM_CHROMIUM")
    program = named or shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip(NO_BROWSER)
    with sync_api.sync_playwright() as playwright:
        # in a container it has no sandbox of its own
        started = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield started
        started.close()
