"""A connection that stays silent does not delay a withdrawal, where the maker serves several clients (results Z2)."""

from __future__ import annotations

import time
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S
from stalling_proxy import StallingProxy
from tests.plugins.vendor_bench import VendorBench, benches, small

from afspm.model import names


@pytest.mark.parametrize(("maker", "needs", "scheme"), [("park", "quickjs", "tcp://"), ("nanosurf", "lupa", "")])
def test_withdrawal_does_not_wait_for_a_silent_connection(tmp_path: Path, maker: str, needs: str, scheme: str) -> None:
    # the answer itself would be awaited for longer than this test
    pytest.importorskip(needs)
    bench = import_module(f"tests.plugins.{maker}.{maker}_bench").Bench
    for make in benches(bench, tmp_path):
        made = make()
        host, _, port = made.address.removeprefix(scheme).rpartition(":")
        with StallingProxy((host, int(port))) as proxy:
            peer = small(made, address=f"{scheme}127.0.0.1:{proxy.port}")
            proxy.stall()
            response = peer.act(names.RETRACT)
            assert response.ok, response.reason
            assert is_left(made)


def is_left(made: VendorBench[Any]) -> bool:
    """Wait until the tip has left the sample; return whether it has in time."""
    until_s, engaged = time.monotonic() + DEADLINE_S, [True]
    while engaged[-1] and time.monotonic() < until_s:
        made.at_panel(lambda emulator: engaged.append(emulator.rig.engaged))
    return not engaged[-1]
