"""For all tests."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import pytest
import zmq
from hypothesis import HealthCheck, settings

# how long one example takes says more about how busy the computer is than about us
any_pace: dict[str, Any] = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("repeatable", **any_pace, derandomize=True, max_examples=60)
# new examples each time, and more of them: AFSPM_EXAMPLES=explore make test
settings.register_profile("explore", **any_pace, max_examples=300)
settings.load_profile(os.environ.get("AFSPM_EXAMPLES", "repeatable"))

# as for a registration in an experiment: on small arrays several threads are slower than one, and take others' cores
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# a shell that runs the tests in the background ignores Ctrl-C for them, and so would everything that they start
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# while tests are collected hardly anything becomes garbage
gc.disable()

COMPUTING = ("tests/simulation/", "tests/unit/")
"""How the names of tests begin that need the processor all the time; the others wait for processes of their own."""
COMPUTERS = 2
"""So many processes do these as long as there are any, beside those that wait: no core is ever idle."""
LONG = ("tests/docs/", "tests/system/experiment/")
"""How the names of tests begin that wait longest: first of those that wait, or one of them would be the last."""
TOGETHER = ("tests/ui/", "tests/unit/components/test_tip_")
"""How the names of tests begin that one process does, in a row, since they share what is made once in a process."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Those that compute come first, those that wait longest at the end, where those that wait are taken from."""
    items.sort(key=lambda item: (not item.nodeid.startswith(COMPUTING), item.nodeid.startswith(LONG)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Who does which test, with pytest-xdist."""
    if sys.platform == "win32":  # a test that takes too long ends its whole process there, which this can't replace
        return None
    from xdist.scheduler import LoadScopeScheduling

    @cache
    def shares(module: str) -> bool:
        return 'scope="module"' in (config.rootpath / module).read_text(encoding="utf-8")

    class FromBothEnds(LoadScopeScheduling):
        """Some take tests from the end of those that compute, the others from the end of those that wait.

        What a module makes once is made once. (The marks of pytest-xdist 3.8 for groups go unseen with pytest 9.2:
        its issue 1386.)
        """

        def _split_scope(self, nodeid: str) -> str:
            module = nodeid.split("::")[0]
            own = module if shares(module) else nodeid
            return next((name for name in TOGETHER if nodeid.startswith(name)), own)

        def _assign_work_unit(self, node: Any) -> None:
            if self.nodes.index(node) >= COMPUTERS:
                self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
            super()._assign_work_unit(node)

    return FromBothEnds(config, log)


def pytest_collection_finish() -> None:
    """What thousands of tests are made of is there to the end: garbage is not looked for in it again and again.

    Nor as often as Python does: a simulated night makes a great many things and little garbage.
    """
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


@pytest.fixture
def plain() -> Iterator[Callable[..., Any]]:
    """`plain(zmq.SUB)`: a socket as a peer of version 1 has it, with nothing of ours."""
    context: zmq.Context[Any] = zmq.Context()
    sockets = []  # or those that a test holds no name for are closed

    def socket(kind: int) -> Any:
        made = context.socket(kind)
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.RCVTIMEO, 10_000)
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
