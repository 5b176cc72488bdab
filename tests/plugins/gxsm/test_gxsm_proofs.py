"""A file of GXSM is published as the scan only if it proves to be it; a person opens and saves files meanwhile."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.plugins.gxsm.gxsm_bench import Bench, hold_scan, scan_until_line
from tests.plugins.vendor_bench import Peer, ready, scanned, scans, states

from afspm import read
from afspm.basics import NS_PER_S
from afspm.model import MeasurementConditions, Region, Scan, ScopeState, names
from afspm.plugins.gxsm.result_files import LATE_S, SOON_S, GxsmFiles
from afspm.translator.judge import Claim, Witness, judge

Make = Callable[..., Bench]
FREE = ScopeState.FREE
KINDS: list[dict[str, Any]] = [{"version": 3}, {}, {"transport": "shm"}]
each_kind = pytest.mark.parametrize("kind", KINDS, ids=["gxsm3", "gxsm4", "shm"])
CASES = Path(__file__).parents[4] / "shared" / "cases" / "gxsm" / "results"


def small(made: Bench, **settings: Any) -> Peer:
    peer = made.start(**settings)
    ready(peer, Region((0.0, 0.0), (100e-9, 1e-6)), (8, 16))
    assert peer.set(names.SCAN_SPEED, "100", "nm/s").ok  # 16 s for a scan: files have whole seconds
    return peer


def with_person(made: Bench, peer: Peer, act: Callable[[Any], object]) -> list[Any]:
    """Take a scan during which a person acts after four of its lines; return all packets."""
    made.at_panel(lambda emulator: hold_scan(emulator.program, 1))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)

    def at_once(emulator: Any) -> None:
        scan_until_line(emulator.program, 4)
        act(emulator.program)

    made.at_panel(at_once)
    return peer.until(FREE)


def first_file(found: dict[str, Scan]) -> Path:
    return Path(next(iter(found.values())).filename)


def is_truth(made: Bench, found: list[Scan]) -> bool:
    """Return whether scans are the pictures in GXSM's memory, which are those of the last scan."""
    program = made.emulator.program
    images = [program.image(channel) * channel.dz for channel in program.channels]
    taken = [scan.values[::-1] / (1e-10 if scan.unit == "m" else 1.0) for scan in found]
    return len(taken) == len(images) and all(map(np.allclose, taken, images))


# results C2
@each_kind
def test_scan_saved_by_a_person_while_it_runs_is_published_whole(bench: Make, kind: dict[str, Any]) -> None:
    made = bench(**kind)
    peer = small(made)
    for _ in range(2):  # before the first scan there is no end of another
        received = with_person(made, peer, lambda program: program.save(program.clock.now_s()))
        assert states(received) == ["FREE"]
        assert is_truth(made, scans(received))


# results X2
@each_kind
@pytest.mark.parametrize("name", ["zz030-M-Xp-{}.nc", "aa030-M-Xp-{}.nc", "scan002-M-Xp-{}.nc.nc", "best.nc"])
def test_half_scan_saved_under_another_name_is_not_published(bench: Make, kind: dict[str, Any], name: str) -> None:
    made = bench(**kind)
    peer = small(made)
    scanned(peer)
    path = made.data / name.format("Topo" if kind.get("version") == 3 else "ZSmTopo")
    received = with_person(made, peer, lambda program: program.save_as(path))
    half = read(path)
    assert half.end_ns is not None
    assert half.start_ns is not None
    assert half.end_ns <= half.start_ns
    assert is_truth(made, scans(received))
    assert is_truth(made, list(scanned(peer).values()))


# results X1
@each_kind
@pytest.mark.parametrize("before", [1, 2, 3])
def test_picture_of_an_earlier_scan_opened_in_a_running_channel_is_not_published(
    bench: Make, kind: dict[str, Any], before: int
) -> None:
    made = bench(**kind)
    peer = small(made)
    paths = [first_file(scanned(peer)) for _ in range(4)]
    received = with_person(made, peer, lambda program: program.open_here(paths[-before]))
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)
    made.until_logged("its channels state starts")
    assert is_truth(made, list(scanned(peer).values()))


def of_last_week(made: Bench) -> Path:
    """Return a picture of the last scan whose start is that of a scan of a week before."""
    path = made.folder / "scan001-M-Xp-ZSmTopo.nc"

    def save(emulator: Any) -> None:
        clock = emulator.file_clock
        clock.shown_s = lambda time_s: time_s - 7 * 86400.0
        emulator.program.save_as(path)
        del clock.shown_s

    made.at_panel(save)
    return path


def test_old_picture_opened_in_the_only_channel_is_not_published(bench: Make) -> None:
    made = bench()
    peer = small(made)
    scanned(peer)
    old = of_last_week(made)
    made.at_panel(lambda emulator: emulator.program.channels.__delitem__(slice(1, None)))
    scanned(peer)
    received = with_person(made, peer, lambda program: program.open_here(old))
    assert states(received) == ["INTERRUPTED", "FREE"]
    made.until_logged("before it could have begun: it is of another measurement")
    assert conditions(peer)[-1].unproved == ()


def test_pictures_kept_as_time_elements_are_no_scan(bench: Make) -> None:
    made = bench()
    peer = small(made)
    path = first_file(scanned(peer))
    scanned(peer)
    made.at_panel(lambda emulator: emulator.program.open_here(path))
    scanned(peer)
    received = with_person(made, peer, lambda program: program.open_here(path))
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert len(read(max(made.data.glob("*-M-Xp-*.nc"))).scans) == 2
    made.until_logged("its file has 2 pictures of a channel")
    assert is_truth(made, list(scanned(peer).values()))


def conditions(peer: Peer) -> list[MeasurementConditions]:
    """Take a scan; return what stands beside its channels."""
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert scans(received)
    return [one for one in received if isinstance(one, MeasurementConditions)]


def test_scan_after_a_jump_of_gxsms_clock_is_unproved_and_published(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    for behind_s, is_jump in ((0.0, False), (3600.0, True), (3600.0, False), (-3600.0, True), (-3600.0, False)):
        made.at_panel(partial(set_behind, behind_s=behind_s))
        assert {len(one.unproved) for one in conditions(peer)} == {int(is_jump)}


def set_behind(emulator: Any, behind_s: float) -> None:
    emulator.file_clock.jump(-behind_s - emulator.file_clock.off_s, emulator.clock.now_s())


FIRST, SECOND = "between057-M-Xp-ZSmTopo.nc", "between057-Xp-ImTunnel.nc"


@pytest.mark.skipif(not CASES.is_dir(), reason="no files of a real Gxsm4 beside the repository")
@pytest.mark.parametrize(
    ("there", "earlier", "own", "rule"),
    [
        (["between030-M-Xp-ZSmTopo.nc", "zz030-M-Xp-ZSmTopo.nc"], ["between029-M-Xp-ZSmTopo.nc"], 0, ""),
        ([FIRST, SECOND], ["between054-M-Xp-ZSmTopo.nc"], 1, "one start"),
        ([FIRST], ["between054-M-Xp-ZSmTopo.nc"], 0, "new start"),
        ([FIRST], [], 0, "own start"),
    ],
)
def test_files_of_the_real_gxsm(tmp_path: Path, there: list[str], earlier: list[str], own: int, rule: str) -> None:
    kept: dict[str, Any] = {}
    files = GxsmFiles(kept, logging.getLogger(), patience_s=10.0, soon_s=SOON_S, late_s=LATE_S)

    def taken(names: list[str], start_ns: int, end_ns: int) -> str:
        frame = {"frame": [0.0, 0.0, 1e-8, 1e-8, 0.0], "shape": [150, 32], "place": []}
        files.begin("scan", tmp_path, start_ns, frame, own=True)
        paths = [Path(shutil.copy(CASES / name, tmp_path)) for name in names]
        files.end(end_ns, end_ns, [str(path) for path in paths if path.name.startswith("between")])
        files.results(0.0)
        return files.results(0.0)[-1]

    for name in earlier:
        before = read(CASES / name)
        taken([name], before.start_ns or 0, before.end_ns or 0)
    # the other scans before it are not among these files
    whole = read(CASES / (SECOND if there[0] == FIRST else there[0]))
    start_ns, end_ns = whole.start_ns or 0, whole.end_ns or 0
    kept["starts"] = [start_ns - 8 * NS_PER_S]
    result = taken(there, start_ns, end_ns)
    assert judge(Claim(start_ns), Witness(), files.stated(result)).rule == rule
    assert {scan.filename for scan in files.load(result)} == {str(tmp_path / name) for name in there[: own + 1]}
