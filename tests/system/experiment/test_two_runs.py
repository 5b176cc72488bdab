"""Two runs at disjoint ports of one emulated Nanonis, and one at another (reports B1)."""

from __future__ import annotations

from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

import pytest
from tests.system.experiment.experiment_lab import AfspmRun

from afspm.basics import ExperimentClock
from afspm.client.connect import join
from afspm.model import ScopeState
from afspm.plugins.nanonis.emulator import NanonisEmulator

EXPERIMENT = """
[microscope]
component = true
class = "Nanonis"
address = "{}"

[scheduler]
component = true
class = "Scheduler"

[limits]
none = true
"""


def wait_until_free(run: AfspmRun) -> None:
    with join(run.folder, "watcher") as scope:
        assert scope.wait_until(lambda: scope.state is ScopeState.FREE)


def test_second_run_is_refused_at_other_ports_of_one_controller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ExitStack() as stack:

        def begun(name: str, address: str) -> AfspmRun:
            (tmp_path / name).mkdir()
            monkeypatch.setenv("TMPDIR", str(tmp_path / name))
            file = tmp_path / f"{name}.toml"
            file.write_text(EXPERIMENT.format(address), encoding="utf-8")
            return stack.enter_context(closing(AfspmRun("run", str(file), "--runs", name, folder=tmp_path)))

        clock, new = ExperimentClock.starting_now(), partial(NanonisEmulator, port=0, ports=4, one_each=True)
        one, other = (stack.enter_context(new().running(tmp_path / name, clock)) for name in ("one", "other"))
        ports = one.removeprefix("127.0.0.1:").split(",")
        wait_until_free(first := begun("a", f"127.0.0.1:{ports[0]},{ports[1]}"))
        second = begun("b", f"localhost:{ports[2]},{ports[3]}")
        second.wait_for(rf"another run already commands this controller: .*{first.folder.name}, process \d+")
        wait_until_free(begun("c", other))
