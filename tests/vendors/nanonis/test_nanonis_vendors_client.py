"""The vendor's own client drives the emulated controller: it knows nothing of us.

Of nanonis-spm 1.0.9 some functions can't read any reply (Util.VersionGet, Scan.PropsGet, BiasSpectr.StatusGet): those
are not called here.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterator
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nanonis_spm import Nanonis as Client

from afspm.clock import ExperimentClock
from afspm.emulators.nanonis import NanonisEmulator, wire
from afspm.files import read

SEEN = pytest.mark.parametrize("client", [2.0], indirect=True)
"""A speed at which what takes a second is seen while it lasts, on a busy computer too."""


@pytest.fixture
def client(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    """Of an emulator at speed 100, or as marked."""
    speed = getattr(request, "param", 100.0)
    emulator = NanonisEmulator(port=0, surface="lattice")
    with emulator.running(tmp_path, ExperimentClock.starting_now(speed=speed)) as address:
        host, port = address.split(":")
        with socket.create_connection((host, int(port)), timeout=20.0) as connection:
            client = Client(connection)
            client.folder = tmp_path
            yield client


def ask(client: Any, function: str, *arguments: Any) -> list[Any]:
    """The results of a function; its errors are failures."""
    error, _, results = getattr(client, function)(*arguments)
    assert error == ""
    return list(results)


def flat(values: Any) -> list[float]:
    """Its lists are of tuples of one."""
    return [value[0] for value in values]


@pytest.mark.parametrize(
    ("setter", "getter", "values"),
    [
        ("Bias_Set", "Bias_Get", [0.75]),
        ("Scan_FrameSet", "Scan_FrameGet", [10e-9, -20e-9, 200e-9, 100e-9, 30.0]),
        ("Scan_SpeedSet", "Scan_SpeedGet", [1e-6, 2e-6, 1.0, 0.5, 1, 2.0]),
        ("ZCtrl_SetpntSet", "ZCtrl_SetpntGet", [5e-11]),
        ("ZCtrl_GainSet", "ZCtrl_GainGet", [1e-12, 1e-4, 1e-8]),
        ("ZCtrl_TipLiftSet", "ZCtrl_TipLiftGet", [1e-9]),
        ("FolMe_SpeedSet", "FolMe_SpeedGet", [3e-7, 1]),
        ("Piezo_TiltSet", "Piezo_TiltGet", [0.5, -0.25]),
        ("BiasSpectr_LimitsSet", "BiasSpectr_LimitsGet", [-0.5, 0.5]),
        ("ZSpectr_RangeSet", "ZSpectr_RangeGet", [0.0, 5e-9]),
        ("TipShaper_PropsSet", "TipShaper_PropsGet", [0.1, 1, 1.0, -1e-9, 0.2, 2.0, 0.1, 5e-9, 0.1, 0.1, 1]),
        ("AtomTrack_PropsSet", "AtomTrack_PropsGet", [1.0, 20.0, 1e-10, 90.0, 0.1]),
        ("Util_RTFreqSet", "Util_RTFreqGet", [5000.0]),
        ("Bias_CalibrSet", "Bias_CalibrGet", [1.5, 0.01]),
        ("Piezo_RangeSet", "Piezo_RangeGet", [2e-6, 3e-6, 4e-7]),
        ("Piezo_SensSet", "Piezo_SensGet", [1e-9, 2e-9, 3e-9]),
        ("ZCtrl_SwitchOffDelaySet", "ZCtrl_SwitchOffDelayGet", [0.01]),
        ("ZCtrl_LimitsSet", "ZCtrl_LimitsGet", [1e-7, -1e-7]),
        ("FolMe_OversamplSet", "FolMe_OversamplGet", [20]),
        ("BiasSpectr_TimingSet", "BiasSpectr_TimingGet", [0.1, 1e-9, 0.01, 10.0, 0.002, 0.02, 0.1, 0.2]),
        ("ZSpectr_RetractDelaySet", "ZSpectr_RetractDelayGet", [0.25]),
    ],
)
def test_what_it_sets_it_gets(client: Any, setter: str, getter: str, values: list[float]) -> None:
    ask(client, setter, *values)
    got = ask(client, getter)
    if setter == "Scan_SpeedSet":  # what is kept counts from 0 here, and the times follow from the frame
        values = [1e-6, 2e-6, 1.0, 0.5, 0, 2.0]
    assert got[: len(values)] == pytest.approx(values, rel=1e-6)


GETTERS = sorted(name.replace(".", "_") for name in wire.functions() if name.endswith("Get"))
UNREADABLE = ("Scan_PropsGet", "Util_VersionGet", "BiasSpectr_StatusGet")


@pytest.mark.parametrize("getter", [name for name in GETTERS if name not in UNREADABLE])
def test_it_reads_the_reply_of_every_getter(client: Any, getter: str) -> None:
    for module in ("BiasSpectr", "ZSpectr", "AutoApproach"):
        ask(client, f"{module}_Open")
    wanted = len(signature(getattr(Client, getter)).parameters) - 1
    arguments = [[0], 0] if getter == "Signals_ValsGet" else [0] * wanted
    assert ask(client, getter, *arguments)


@SEEN
def test_it_takes_a_scan_and_the_file_of_it_is_one_of_nanonis(client: Any) -> None:
    ask(client, "Scan_PropsSet", 2, 2, 1, "series_", "comment", ["Z-Ctrl"], 0)
    ask(client, "Scan_FrameSet", 0.0, 0.0, 10e-9, 5e-9, -90.0)
    ask(client, "Scan_SpeedSet", 2e-7, 2e-7, 0.05, 0.05, 1, 1.0)  # else it may have ended before it is waited for
    ask(client, "Scan_BufferSet", [0, 14], 30, 16)
    assert ask(client, "Scan_BufferGet")[2:] == [32, 16]
    ask(client, "Scan_Action", 0, 0)
    timed_out, _, path = ask(client, "Scan_WaitEndOfScan", -1)
    assert (timed_out, path) == (0, str(client.folder / "series_001.sxm"))
    content = read(path)
    assert content.upwards is False
    assert [scan.channel for scan in content.scans] == [
        "Current Forward",
        "Current Backward",
        "Z Forward",
        "Z Backward",
    ]
    region = content.scans[0].region
    assert region.angle_rad == pytest.approx(math.pi / 2)
    assert region.size_m == pytest.approx((10e-9 * 31 / 32, 5e-9 * 15 / 16))
    _, name, rows, columns, values, direction = ask(client, "Scan_FrameDataGrab", 14, 1)
    assert (name, rows, columns, direction) == ("Z (m)", 16, 32, 0)
    np.testing.assert_allclose(values[::-1], content.scans[2].values)


def test_it_stops_a_scan_and_the_wait_for_its_end_is_over(client: Any) -> None:
    ask(client, "Scan_BufferSet", [0], 512, 512)
    ask(client, "Scan_Action", 0, 1)
    assert ask(client, "Scan_StatusGet") == [1]
    assert ask(client, "Scan_WaitEndOfScan", 100)[0] == 1
    ask(client, "Scan_Action", 1, 0)
    assert ask(client, "Scan_StatusGet") == [0]


@pytest.mark.parametrize(("module", "first"), [("BiasSpectr", "Bias calc (V)"), ("ZSpectr", "Z rel (m)")])
def test_it_takes_a_spectrum_with_a_row_for_each_channel(client: Any, module: str, first: str) -> None:
    """As in the examples that come with it."""
    ask(client, f"{module}_Open")
    _, count, names, rows, _, values, *_ = ask(client, f"{module}_Start", 1, "curve")
    assert (names[0], rows) == (first, count)
    (spectrum,) = read(client.folder / "curve00001.dat").spectra
    np.testing.assert_allclose(values.T, spectrum.values, rtol=1e-4, atol=1e-18)


@SEEN
@pytest.mark.parametrize("module", ["BiasSpectr", "ZSpectr"])
def test_it_stops_a_spectrum_and_there_is_no_file_of_it(client: Any, module: str) -> None:
    ask(client, f"{module}_Open")
    ask(client, f"{module}_Start", 0, "curve")
    ask(client, f"{module}_Stop")
    assert not list(client.folder.glob("curve*"))
    if module == "ZSpectr":  # it can't read the other's status
        assert ask(client, "ZSpectr_StatusGet") == [0]


def test_a_spectrum_has_the_sweep_and_the_points_that_it_sets(client: Any) -> None:
    for module in ("BiasSpectr", "ZSpectr"):
        ask(client, f"{module}_Open")
    all_of_it = ask(client, "BiasSpectr_Start", 1, "curve")[5]
    no_change, off = 0, 2
    ask(client, "BiasSpectr_LimitsSet", 0.5, -0.25)
    ask(client, "BiasSpectr_PropsSet", no_change, 1, no_change, 31, 0.0, no_change, no_change)
    _, count, names, rows, points, values, *_ = ask(client, "BiasSpectr_Start", 1, "curve")
    assert (names[0], rows, points) == ("Bias calc (V)", count, 31)
    assert any("[bwd]" in name for name in names)
    np.testing.assert_allclose(values[0], np.linspace(0.5, -0.25, 31), atol=1e-6)
    between = np.interp(values[0], all_of_it[0], all_of_it[1])
    assert np.corrcoef(values[1], between)[0, 1] > 0.9  # the same place of the same sample
    ask(client, "ZSpectr_PropsSet", off, 40, 1, no_change, no_change, no_change)
    _, _, names, _, points, *_ = ask(client, "ZSpectr_Start", 1, "curve")
    assert (points, [name for name in names if "[bwd]" in name]) == (40, [])
    assert ask(client, "ZSpectr_PropsGet")[:2] == [0, 40]
    (saved,) = read(client.folder / "curve00002.dat").spectra
    assert len(saved.values) == 31


def test_it_stops_the_tip_on_its_way(client: Any) -> None:
    ask(client, "FolMe_SpeedSet", 1e-9, 1)
    ask(client, "FolMe_XYPosSet", 500e-9, 0.0, 0)
    ask(client, "FolMe_Stop")
    stopped = ask(client, "FolMe_XYPosGet", 1)
    assert 0.0 <= stopped[0] < 400e-9
    assert ask(client, "FolMe_XYPosGet", 1) == stopped
    assert ask(client, "Scan_XYPosGet", 1) == pytest.approx(stopped, rel=1e-6)


def test_it_switches_the_z_controller_which_follows_with_a_delay(client: Any) -> None:
    for on in (0, 1):
        ask(client, "ZCtrl_OnOffSet", on)
        until_s = time.monotonic() + 20.0
        while ask(client, "ZCtrl_OnOffGet") != [on]:
            assert time.monotonic() < until_s
        assert ask(client, "ZCtrl_StatusGet") == [2 if on else 1]


def test_it_sets_z_with_the_controller_off_alone(client: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert client.ZCtrl_ZPosSet(1e-9)[0]
    assert "The following error appeared" in capsys.readouterr().out
    ask(client, "ZCtrl_OnOffSet", 0)
    until_s = time.monotonic() + 20.0
    while ask(client, "ZCtrl_OnOffGet") != [0]:
        assert time.monotonic() < until_s
    ask(client, "ZCtrl_ZPosSet", 1e-9)
    assert ask(client, "ZCtrl_ZPosGet") == pytest.approx([1e-9])


def test_it_has_the_drift_compensated(client: Any) -> None:
    on, off = 1, 2
    ask(client, "Piezo_DriftCompSet", on, 1e-11, -2e-11, 0.0, 10.0)
    assert ask(client, "Piezo_DriftCompGet") == pytest.approx([1, 1e-11, -2e-11, 0.0, 0, 0, 0, 10.0], rel=1e-6)
    ask(client, "Piezo_DriftCompSet", off, 1e-11, -2e-11, 0.0, 10.0)
    assert ask(client, "Piezo_DriftCompGet")[0] == 0


def test_it_has_a_scan_saved_that_was_stopped(client: Any) -> None:
    ask(client, "Scan_PropsSet", 2, 2, 3, "part_", "", [], 0)
    ask(client, "Scan_BufferSet", [0, 14], 64, 64)
    ask(client, "Scan_Action", 0, 1)
    ask(client, "Scan_Action", 2, 0)
    ask(client, "Scan_Action", 3, 0)
    ask(client, "Scan_Action", 1, 0)
    assert ask(client, "Scan_Save", 1, -1) == [0]
    assert [path.name for path in client.folder.glob("*.sxm")] == ["part_001.sxm"]


def test_it_moves_the_tip_and_waits_until_it_is_there(client: Any) -> None:
    ask(client, "FolMe_XYPosSet", 50e-9, -30e-9, 1)
    assert ask(client, "FolMe_XYPosGet", 1) == [50e-9, -30e-9]


def test_it_reads_lists_of_names_and_values(client: Any) -> None:
    *_, names = ask(client, "Signals_NamesGet")
    assert len(names) == 128
    assert (names[0], names[14]) == ("Current (A)", "Z (m)")
    ask(client, "Bias_Set", 0.5)
    _, values = ask(client, "Signals_ValsGet", [0, names.index("Bias (V)")], 1)
    assert flat(values) == [0.0, 0.5]
    *_, controllers, active = ask(client, "ZCtrl_CtrlListGet")
    assert (controllers, active) == (["log Current"], 0)
    assert ask(client, "Util_SessionPathGet")[1] == str(client.folder)


@SEEN
def test_it_withdraws_pulses_shapes_and_walks(client: Any) -> None:
    ask(client, "Bias_Pulse", 1, 0.1, 4.0, 1, 2)
    ask(client, "TipShaper_Start", 1, -1)
    ask(client, "Motor_StartMove", 4, 10, 0, 1)
    assert ask(client, "Motor_PosGet", 0, 500)[2] > 0.0
    assert ask(client, "ZCtrl_StatusGet") == [2]
    ask(client, "ZCtrl_Withdraw", 1, -1)
    assert ask(client, "ZCtrl_StatusGet") == [1]
    ask(client, "AutoApproach_Open")
    ask(client, "AutoApproach_OnOffSet", 1)
    assert ask(client, "AutoApproach_OnOffGet") == [1]


def test_it_is_told_in_words_what_can_not_be(client: Any, capsys: pytest.CaptureFixture[str]) -> None:
    for function, arguments in (("Bias_Set", (99.0,)), ("Scan_FrameDataGrab", (99, 1)), ("LockIn_ModOnOffGet", (1,))):
        error, *_ = getattr(client, function)(*arguments)
        assert error
    assert "The following error appeared" in capsys.readouterr().out
