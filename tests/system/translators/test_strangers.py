"""The suite, where a real controller listens at the vendor's usual port: it is asked nothing at all."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from afspm_process import AFSPM
from deadlines import DEADLINE_S
from makers import MAKERS

from afspm.simulation.emulation.emulator import find_emulator


def checked(folder: Path, *files: Path) -> dict[str, Any]:
    """The report of two quick checks."""
    command = [
        *AFSPM,
        "test-translator",
        *map(str, files),
        "-k",
        "feedback/one",
        "-k",
        "probe/move",
        "--runs",
        str(folder),
    ]
    report = folder / "report.json"
    done = subprocess.run(
        [*command, "--report", str(report)], capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found: dict[str, Any] = json.loads(report.read_text(encoding="utf-8"))
    return found


@pytest.mark.parametrize("vendor", sorted(MAKERS))
def test_no_byte_reaches_who_has_the_vendors_usual_port(
    vendor: str, tmp_path: Path, strangers: Callable[..., AbstractContextManager[Any]]
) -> None:
    usual = find_emulator(vendor).usual
    with strangers(*range(usual["port"], usual["port"] + usual.get("ports", 1))):
        assert checked(tmp_path, MAKERS[vendor].emulated)["simulated"] is True


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Gxsm4's shared memory is there on Linux alone")
def test_no_call_reaches_the_shared_memory_of_a_gxsm_that_is_not_the_emulated_one(tmp_path: Path) -> None:
    from afspm.basics.clock import ExperimentClock
    from afspm.plugins.gxsm.emulator import GxsmEmulator
    from afspm.plugins.gxsm.emulator.block import SharedMemoryBlock
    from afspm.simulation.faults import Faults

    name = GxsmEmulator.usual["block"]
    if Path("/dev/shm", name).exists():
        pytest.skip(f"a Gxsm4, or another test, has {name}")
    overlay = tmp_path / "shm.toml"
    overlay.write_text('[controller]\ntransport = "shm"\n[microscope]\naddress = "shm"\n', encoding="utf-8")
    calls: list[Any] = []
    clock = ExperimentClock.real()
    real = SharedMemoryBlock(
        name, GxsmEmulator.usual["process"], tmp_path, Faults([], {}, clock.now_s()), clock.now_s, calls.append
    )
    try:
        before = Path("/dev/shm", name).read_bytes()
        assert checked(tmp_path, MAKERS["gxsm"].emulated, overlay)["simulated"] is True
        assert Path("/dev/shm", name).read_bytes() == before
        assert calls == []
    finally:
        real.end()
