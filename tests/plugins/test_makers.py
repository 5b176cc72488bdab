"""The contract of every maker's translator, with its emulated controller."""

from __future__ import annotations

import math
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deadlines import DEADLINE_S
from tests.plugins.by_hand import acts
from tests.plugins.vendor_bench import TURNED, VendorBench, benches, ready, scanned, scans, small, states

from afspm import read
from afspm.basics import AfspmError, load_plugin
from afspm.driver import FileContent
from afspm.model import ControlResponse, PanelAct, ScopeState, names

FREE = ScopeState.FREE
Make = Callable[..., VendorBench[Any]]


@dataclass(frozen=True)
class Maker:
    """A maker.

    Attributes:
        name: name of its folder.
        height: channel of the heights, forward.
        number: pattern for a file name, with the scan's number as its group.
        start: starts a scan at the panel, given the emulator and the time.
    """

    name: str
    height: str
    number: str
    start: Callable[[Any, float], None]


def start_program(emulator: Any, now_s: float) -> None:
    emulator.program.start_scan(now_s)


def start_asylum(emulator: Any, now_s: float) -> None:
    emulator.controller.values.put("LastScan", 1)  # else one scan follows the other
    emulator.controller.scan(now_s, None)


MAKERS = {
    maker.name: maker
    for maker in (
        Maker("asylum", "HeightTrace", r"Image(\d+)\.ibw$", start_asylum),
        Maker("gxsm", "ZS-Topo", r"(\d+)-M-Xp-ZSmTopo\.nc$", lambda emulator, now_s: emulator.program.start_scan()),
        Maker(
            "nanonis",
            "Z Forward",
            r"(\d{3})\.sxm$",
            lambda emulator, now_s: emulator.software.scans.start(upwards=True),
        ),
        Maker("nanosurf", "Height Forward", r"(\d+)\.nhf$", start_program),
        Maker("park", "Height Forward", r"_(\d+)_Height_Forward\.tiff$", start_program),
    )
}
each = pytest.mark.parametrize("maker", MAKERS.values(), ids=MAKERS)


@pytest.fixture
def bench(maker: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    monkeypatch.syspath_prepend(str(Path(__file__).parent / maker.name))
    monkeypatch.setenv("HOME", str(tmp_path))  # GXSM's bridge has its secret there
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    yield from benches(import_module(f"{maker.name}_bench").Bench, tmp_path)


@each
def test_consecutive_scans_have_files_of_their_own(maker: Maker, bench: Make) -> None:
    peer = bench().start()
    ready(peer)
    found = [scanned(peer)[maker.height] for _ in range(3)]
    matches = [re.search(maker.number, scan.filename) for scan in found]
    assert all(matches), [scan.filename for scan in found]
    first, *others = [int(match[1]) for match in matches if match]
    assert first in (0, 1)
    assert others == [first + 1, first + 2]
    assert not np.array_equal(found[0].values, found[1].values)


def until_file(maker: Maker, folder: Path, before: set[Path]) -> tuple[Path, FileContent]:
    """Wait until another scan is saved; return its file with the heights, and what that contains."""
    deadline_s = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline_s:
        for file in set(folder.iterdir()) - before:
            if re.search(maker.number, file.name):
                with suppress(AfspmError, OSError):  # it is being written
                    return file, read(file)
    raise AssertionError(f"no new file among {list(folder.iterdir())}")


@each
@pytest.mark.parametrize("dates_files", [False, True])
def test_times_in_files_follow_the_clock_of_the_controller(maker: Maker, bench: Make, *, dates_files: bool) -> None:
    driver = load_plugin("afspm.drivers", maker.name.capitalize())
    made = bench(speed=20.0, clock_off_s=-300.0, dates_files=dates_files)
    small(made)
    made.kill()  # only the emulated controller is tested here
    for off_s in (-300.0, 600.0):
        before, begin_s, real_s = set(made.data.iterdir()), made.clock.now_s(), time.time()
        made.at_panel(lambda emulator: maker.start(emulator, made.clock.now_s()))
        file, content = until_file(maker, made.data, before)
        end_s = made.clock.now_s()
        times_ns = [one for one in (content.start_ns, content.end_ns) if one is not None]
        assert times_ns
        assert (content.end_ns is None) == ("end in the file" in driver.never_shows)
        for time_ns in times_ns:  # in whole seconds
            assert begin_s - 1.0 <= time_ns * 1e-9 - off_s <= end_s + 1.0
        deadline_s = time.monotonic() + DEADLINE_S
        # an emulator dates a file right after it has written it
        while not real_s - 1.0 <= (s := file.stat().st_mtime - (off_s if dates_files else 0.0)) <= time.time() + 1.0:
            assert time.monotonic() < deadline_s, s
        made.strike("clock-ahead", duration_s=900.0)


@pytest.mark.parametrize("maker", [MAKERS[name] for name in ("nanonis", "nanosurf", "park")], ids=lambda one: one.name)
def test_stopped_scan_is_not_published(maker: Maker, bench: Make) -> None:
    # GXSM and Asylum (which withdraws the tip) have further tests of their own.
    peer = bench(speed=10.0).start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    assert states(peer.until(ScopeState.SCANNING)) == ["SCANNING"]
    assert peer.act(names.STOP_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)
    assert peer.act(names.STOP_SCAN).ok, "nothing to stop is no error"


@pytest.mark.parametrize("maker", [MAKERS[name] for name in ("nanosurf", "park")], ids=lambda one: one.name)
def test_older_file_is_no_result_when_the_network_drive_returns(maker: Maker, bench: Make) -> None:
    made = bench(speed=10.0)
    peer = made.start()
    ready(peer)
    scanned(peer)  # unknown to the next translator
    made.kill()
    shutil.rmtree(made.folder / "state")
    peer = made.start()
    ready(peer, shape=(64, 32))
    away = made.data.rename(made.folder / "away")
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)

    def returns(_: object) -> None:
        if made.data.is_dir():  # on a busy computer the scan is over by now, and saved in a new folder
            shutil.copytree(made.data, away, dirs_exist_ok=True)
            shutil.rmtree(made.data)
        away.rename(made.data)

    made.at_panel(returns)
    assert {scan.shape for scan in scans(peer.until(FREE))} == {(64, 32)}


@pytest.mark.parametrize("maker", [MAKERS[name] for name in ("nanosurf", "park")], ids=lambda one: one.name)
def test_frame_is_refused_if_its_line_rate_is_raised(
    maker: Maker, bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = bench()
    peer = small(made)
    assert peer.set(names.SCAN_SPEED, 2e-7).ok
    setter = {"nanosurf": "put", "park": "_set"}[maker.name]
    plain = getattr(made.emulator.program, setter)

    def raised(path: str, value: Any) -> None:
        plain(path, max(value, 0.1) if path.endswith("rate") else value)

    monkeypatch.setattr(made.emulator.program, setter, raised)
    response = peer.set(names.SCAN_SIZE_X, 50e-6)
    assert "would scan this frame at 10 µm/s instead of 0.2 µm/s" in response.reason
    assert float(peer.get(names.SCAN_SIZE_X)) == pytest.approx(1e-6)
    assert float(peer.get(names.SCAN_SPEED)) == pytest.approx(2e-7)


@each
def test_scan_from_the_panel_is_published(maker: Maker, bench: Make) -> None:
    made = bench(speed=20.0)
    peer = made.start()
    ready(peer, shape=(40, 32))
    made.at_panel(lambda emulator: maker.start(emulator, made.clock.now_s()))
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "FREE"]
    assert acts(received) == [PanelAct.SCAN]
    assert scans(received)
    for region in {scan.region for scan in scans(received)}:  # Nanonis has a float32 of each length
        assert (*region.center_m, *region.size_m) == pytest.approx((*TURNED.center_m, *TURNED.size_m), rel=1e-6)
        assert region.angle_rad == pytest.approx(TURNED.angle_rad)


@pytest.mark.parametrize("maker", [MAKERS[name] for name in ("asylum", "nanosurf", "park")], ids=lambda one: one.name)
def test_scan_that_does_not_start_is_refused(maker: Maker, bench: Make) -> None:
    # Not GXSM and Nanonis, whose scans may start late.
    made = bench()
    peer = small(made)
    # results M5: a person may have stopped it at once, and two programs do not report a person's other work
    codes = [ControlResponse.NOT_FREE] * (0 if maker.name == "asylum" else 2) + [ControlResponse.ACTION_ERROR]
    made.strike("scan-refused", len(codes))
    for code in codes:
        response = peer.act(names.START_SCAN)
        assert response.code == code
        assert "did not begin the scan that it was asked for" in response.reason
    assert scanned(peer), "the next one is taken"


@each
def test_each_number_has_bounds_that_hold_though_the_maker_takes_all(maker: Maker, bench: Make) -> None:
    made = bench()
    peer = small(made)
    if "takes-all" in made.emulator.all_faults():  # Asylum's PV checks nothing, as of a real one
        made.strike("takes-all", duration_s=1e9)
    driver = load_plugin("afspm.drivers", maker.name.capitalize())
    for name, row in driver.parameter_table({}).items():
        if not row.is_number or row.read_only:
            continue
        low, high = row.range
        assert math.isfinite(low), name
        assert math.isfinite(high), name
        before = peer.get_response(name)
        if before.code == ControlResponse.PARAM_NOT_SUPPORTED:
            continue
        step = row.multiple if row.type == "int" else 0.01 * (high - low)
        for beyond in (low - step, high + step):
            response = peer.set(name, beyond, row.si_unit or None)
            assert response.code == ControlResponse.PARAM_ERROR, name
            assert "is outside" in response.reason
        assert peer.get_response(name).payload == before.payload, name
