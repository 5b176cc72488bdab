"""A file of GXSM is published as the scan only if it proves to be it; a person opens and saves files meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.plugins.by_hand import acts
from tests.plugins.gxsm.gxsm_bench import Bench, hold_scan, scan_to_line
from tests.plugins.vendor_bench import Peer, ready, scanned, scans, states

from afspm import read
from afspm.model import MeasurementConditions, Region, Scan, ScopeState, names

Make = Callable[..., Bench]
FREE = ScopeState.FREE
KINDS: list[dict[str, Any]] = [{"version": 3}, {}, {"transport": "shm"}]
each_kind = pytest.mark.parametrize("kind", KINDS, ids=["gxsm3", "gxsm4", "shm"])


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
        scan_to_line(emulator.program, 4)
        act(emulator.program)
        emulator.program.resume_scan()

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


# results X2
def test_half_scan_of_before_in_a_new_folder_is_not_named(bench: Make, tmp_path: Path) -> None:
    made = bench()
    peer = small(made)
    half, other = tmp_path / "zz030-M-Xp-ZSmTopo.nc", tmp_path / "other"
    other.mkdir()
    assert scans(with_person(made, peer, lambda program: program.save_as(half)))
    (other / half.name).write_bytes(half.read_bytes())  # newer than all files in the folder of before
    made.at_panel(lambda emulator: setattr(emulator.program.saving, "folder", other))
    assert is_truth(made, list(scanned(peer).values()))
    assert "is left out" not in made.log_text()


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
    made.until_logged(
        "its channels state starts" if before > 1 else "was that file opened in its window?"
    )  # results X8
    assert not acts(received)
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
