"""`LineWatch` on the lines that the translators of emulated controllers publish."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from client_lab import Lab, run
from tests.plugins.gxsm.gxsm_bench import Bench as GxsmBench
from tests.plugins.line_watch.test_line_watch import flags, verdicts
from tests.plugins.nanonis.nanonis_bench import Bench as NanonisBench
from tests.plugins.nanosurf.nanosurf_bench import Bench as NanosurfBench
from tests.plugins.vendor_bench import VendorBench, benches, ready

from afspm.basics import Clock
from afspm.emulation import Emulator, ScanActivity
from afspm.model import Region, Scan, ScanLines, ScopeState, ScopeStatus, names
from afspm.plugins.line_watch.line_judge import FEWEST_PAIRS
from afspm.plugins.line_watch.line_watch import LineWatch

pytestmark = [pytest.mark.slow]  # six scans each, at the pace of a controller

REGION, SHAPE = Region((0.0, 0.0), (1e-6, 1e-6)), (64, 64)
CHANGED_LINE, HELD_LINE = 32, 60
PUBLISHED = 52  # lines: translators leave out the newest ones
LEARNT = FEWEST_PAIRS + 1
Packets = list[ScanLines | Scan]


class Maker(NamedTuple):
    bench: type[VendorBench[Any]]
    channels: tuple[str, str]
    emulator: Mapping[str, Any] = {}
    settings: Mapping[str, Any] = {}


MAKERS = {
    "nanonis": Maker(NanonisBench, ("Z Forward", "Z Backward")),
    "gxsm3": Maker(GxsmBench, ("Topo", "Topo Backward"), {"version": 3}),
    "gxsm4": Maker(GxsmBench, ("ZS-Topo", "ZS-Topo Backward"), {"version": 4}),
    "nanosurf": Maker(NanosurfBench, ("Height Forward", "Height Backward"), settings={"image_buffer": 4410}),
}


@pytest.fixture(params=MAKERS)
def maker(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Maker:
    for name in ("HOME", "USERPROFILE", "TMPDIR"):  # of the secret of Gxsm's bridge, and of its lock
        monkeypatch.setenv(name, str(tmp_path))
    return MAKERS[request.param]


@pytest.fixture
def bench(maker: Maker, tmp_path: Path) -> Iterator[Callable[..., VendorBench[Any]]]:
    yield from benches(maker.bench, tmp_path)


def test_changed_tip_stops_the_scan_of_a_maker_and_a_good_scan_goes_on(
    maker: Maker, bench: Callable[..., VendorBench[Any]]
) -> None:
    made = bench(speed=20.0, surface={"kind": "particles"}, **maker.emulator)
    peer = made.start(live_lines_s=1.0, **maker.settings)
    ready(peer, REGION, SHAPE)
    assert peer.set(names.SCAN_SPEED, 3, "um/s").ok

    def scanned(*, held: bool = True) -> Packets:
        response = peer.act(names.START_SCAN)
        assert response.ok, response.reason
        packets = peer.until(is_scanning)
        if held:
            packets += peer.until(has_published(PUBLISHED, maker.channels, packets))
            made.at_panel(partial(release_scan, made.clock))
        packets += peer.until(ScopeState.FREE)
        return [one for one in packets if isinstance(one, ScanLines | Scan) and one.channel in maker.channels]

    scanned(held=False)  # Gxsm publishes no lines of the first one: only its file has the names of the channels
    made.at_panel(hold_scans)
    night = [scanned() for _ in range(LEARNT + 1)]
    made.at_panel(partial(change_tip_in_scans, "double"))
    changed = scanned()

    lab = Lab("line_watch")
    for number, packets in enumerate([*night, changed]):
        at_s = 100.0 * (1.0 + number)
        lab.at(at_s, partial(lab.publish, ScopeStatus(ScopeState.SCANNING)))
        for packet in packets:
            if isinstance(packet, ScanLines) or packets is not changed:
                lab.at(at_s, partial(lab.publish, packet))
    lab.at(2000.0, lab.kill)
    run(LineWatch(*maker.channels, action="stop"), lab)
    assert [one.began_ns for one in verdicts(lab) if one.stops] == [began_ns(changed)]
    assert {one.began_ns for one in verdicts(lab)} == {began_ns(changed)}
    assert flags(lab) == 1


def began_ns(packets: Packets) -> int:
    found = next(one.began_ns for one in packets if isinstance(one, ScanLines))
    assert found is not None
    return found


def is_scanning(packet: object) -> bool:
    return isinstance(packet, ScopeStatus) and packet.state is ScopeState.SCANNING


def has_published(lines: int, channels: tuple[str, ...], before: Sequence[object]) -> Callable[[object], bool]:
    """Return a condition that holds once as many lines of each channel have come."""
    come = dict.fromkeys(channels, 0)

    def see(packet: object) -> bool:
        if isinstance(packet, ScanLines) and packet.channel in come:
            come[packet.channel] += len(packet.values)
        return min(come.values()) >= lines

    for packet in before:
        see(packet)
    return see


def hold_scans(emulator: Emulator) -> None:
    """Let each scan wait before its last lines: a busy translator publishes none after the end of a scan."""
    start = emulator.rig.start_scan

    def start_and_hold(now_s: float) -> ScanActivity:
        scan = start(now_s)
        scan.pause(now_s + HELD_LINE * scan.line_s)
        return scan

    vars(emulator.rig).update(start_scan=start_and_hold)


def release_scan(clock: Clock, emulator: Emulator) -> None:
    scan = emulator.rig.scan
    assert scan is not None
    assert scan.paused_since_s is not None
    scan.resume(max(scan.paused_since_s, clock.now_s()))


def change_tip_in_scans(flaw: str, emulator: Emulator) -> None:
    """Let the tip change at the same line of each scan, however late the scan begins."""
    start = emulator.rig.start_scan

    def start_and_change(now_s: float) -> ScanActivity:
        emulator.rig.world.change_tip(flaw, now_s + CHANGED_LINE * emulator.rig.setup.line_s)
        return start(now_s)

    vars(emulator.rig).update(start_scan=start_and_change)
