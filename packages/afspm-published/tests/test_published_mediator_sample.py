"""The sample of components under a published mediator, with a mediator of version 1 in place of the published one."""

from __future__ import annotations

import re
import threading
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.system.experiment.experiment_lab import Run
from version_1 import Mediator

import afspm
from afspm.supervisor.ports import FreePorts

SAMPLE = Path(__file__).parents[3] / "experiments/published_mediator"


def variables(file: str) -> dict[str, Any]:
    return tomllib.loads((SAMPLE / file).read_text(encoding="utf-8"))


@pytest.fixture
def mediator(plain: Callable[[int], Any]) -> Iterator[Callable[[str, str], Mediator]]:
    """Start a mediator with these addresses of its translator, in a thread."""
    stopping = threading.Event()
    threads: list[threading.Thread] = []
    failures: list[BaseException] = []

    def start(server: str, source: str) -> Mediator:
        made = Mediator(plain, server, source)

        def run() -> None:
            try:
                while not stopping.is_set():
                    made.wait(50)
                    made.pump()
            except BaseException as error:
                failures.append(error)

        threads.append(threading.Thread(target=run, name="mediator"))
        threads[-1].start()
        return made

    yield start
    stopping.set()
    for thread in threads:
        thread.join()
    assert failures == []


def test_addresses_of_the_three_files_agree() -> None:
    microscope, theirs, ours = map(variables, ("microscope.toml", "mediator.toml", "experiment.toml"))
    assert (microscope["serve"], microscope["publish"]) == (theirs["server_url"], theirs["pub_url"])
    assert (ours["serve"], ours["publish"]) == (theirs["router_url"], theirs["psc_url"])


def test_sample_records_the_scans_that_its_mediator_lets_the_microscope_take(
    afspm_run: Run, tmp_path: Path, mediator: Callable[[str, str], Mediator]
) -> None:
    ports = FreePorts()
    server, source = ports.address(), ports.address()
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text(f'serve = "{server}"\npublish = "{source}"\n', encoding="utf-8")
    microscope = afspm_run(str(SAMPLE / "microscope.toml"), str(first), "--runs", str(tmp_path / "first"))
    microscope.wait_up("published_mediator", 1)
    theirs = mediator(server, source)
    second.write_text(
        f'serve = "{theirs.address}"\npublish = "{theirs.published}"\n[series]\nevery = "2 s"\npixels = [16, 16]\n',
        encoding="utf-8",
    )
    ours = afspm_run(str(SAMPLE / "experiment.toml"), str(second), "--runs", str(tmp_path / "second"))
    assert ours.end() == 0, ours.output
    assert theirs.ended
    assert not [line for line in ours.lines if re.search(r" (ERROR|CRITICAL) ", line)], ours.output
    with afspm.open_run(ours.folder) as record, afspm.open_run(microscope.folder) as truth:
        assert (len(record.scans), len(truth.scans)) == (2, 2), ours.output
        for i in range(2):
            taken, measured = record.scan(i), truth.scan(i)
            assert set(taken) == set(measured)
            assert all(np.array_equal(taken[channel].values, measured[channel].values) for channel in taken)
