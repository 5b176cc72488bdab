"""The vendor's own client drives the emulated controller.

Some functions of nanonis-spm 1.0.9 can't read any reply (`MISREAD`): they are not called here.
"""

from __future__ import annotations

import importlib.util
import math
import runpy
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from inspect import isfunction, signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deadlines import DEADLINE_S
from nanonis_spm import Nanonis as Client

from afspm import read
from afspm.basics import ExperimentClock
from afspm.plugins.nanonis.emulator import NanonisEmulator

SEEN = pytest.mark.parametrize("client", [2.0], indirect=True)
"""A speed at which what takes a second is seen while it lasts, on a busy computer too."""


@pytest.fixture
def client(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    """Connect the client to an emulator, at speed 100 or as marked."""
    with connected(tmp_path, getattr(request, "param", 100.0)) as client:
        yield client


@contextmanager
def connected(folder: Path, speed: float, **settings: Any) -> Iterator[Any]:
    emulator = NanonisEmulator(port=0, **{"surface": "lattice", **settings})
    with emulator.running(folder, ExperimentClock.starting_now(speed=speed)) as address:
        host, port = address.split(":")
        with socket.create_connection((host, int(port)), timeout=DEADLINE_S) as connection:
            client = Client(connection)
            client.folder = folder
            yield client


def ask(client: Any, function: str, *arguments: Any) -> list[Any]:
    """Call a function; its errors are failures of the test."""
    error, _, results = getattr(client, function)(*arguments)
    assert error == ""
    return list(results)


def flat(values: Any) -> list[float]:
    """Return the items of the client's lists, which are tuples of one."""
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
def test_client_reads_the_values_that_it_sets(client: Any, setter: str, getter: str, values: list[float]) -> None:
    ask(client, setter, *values)
    got = ask(client, getter)
    if setter == "Scan_SpeedSet":  # SpeedGet counts `keep` from 0, and the times follow from the frame
        values = [1e-6, 2e-6, 1.0, 0.5, 0, 2.0]
    assert got[: len(values)] == pytest.approx(values, rel=1e-6)


MISREAD = {
    "BiasSpectr_StatusGet": "reads no status",
    "BiasSpectr_PropsGet": "as of releases before 11798",
    "ZSpectr_PropsGet": "as of releases before 11798",
    "Scan_PropsGet": "a table as a list",
    "Util_VersionGet": "texts that it can only send",
    "HSSwp_SwpChSigListGet": "texts that it can only send",
    "HSSwp_SaveBasenameGet": "a length too few",
    "Osci1T_TrigGet": "nothing",
    "Osci2T_TrigGet": "nothing",
    "Osci2T_OversamplGet": "the reply to another function",
    "Osci1T_TimebaseGet": "the reply to another function",
    "Osci2T_TimebaseGet": "the reply to another function",
    "Osci2T_ChGet": "the reply to another function",
    "SpectrumAnlzr_DataGet": "half of each number",
    "Marks_PointsGet": "texts counted by their bytes",
    "PLLSignalAnlzr_OsciDataGet": "a number for a length",
    "CPDComp_DataGet": "one length for two kinds of lists",
    "PLL_PhasCtrlGainGet": "two of three numbers",
    "DigLines_TTLValGet": "sends 16 bits of a port of 32",
}
"""What the client can't read, and how it reads it; or sends otherwise than documented."""

FUNCTIONS = [name for name, made in vars(Client).items() if isfunction(made) and "quickSend" in made.__code__.co_names]
NOISE_M = 0.5e-9
"""More than z has of it."""

ALIVE = (
    "Bias", "BiasSpectr", "Current", "ZCtrl", "SafeTip", "AutoApproach", "ZSpectr", "Piezo", "Scan", "FolMe", "Pattern",
    "TipShaper", "Motor", "AtomTrack", "LockIn", "PLL", "Signals", "UserIn", "UserOut", "TCPLog", "Util",
)  # fmt: skip


def test_client_reads_the_error_of_every_function(client: Any, capsys: pytest.CaptureFixture[str]) -> None:
    # After the results of the client's own list of fields: the emulator has the same list.
    send, misread = client.send, set()
    for name in FUNCTIONS:
        client.send = lambda command, _body, _codes: send(command, [[1]], ["*B"])  # a byte fits nothing
        try:
            error, *_ = getattr(client, name)(*[0] * (len(signature(getattr(Client, name)).parameters) - 1))
        except (TypeError, struct.error, IndexError, UnicodeDecodeError):
            error = ""
        if not (error.startswith("Error in command: ") and "bytes of arguments" in error):
            misread.add(name)
    assert misread <= set(MISREAD)
    assert len(FUNCTIONS) == 667
    assert "The following error appeared" in capsys.readouterr().out


def test_client_reads_the_reply_of_every_getter(client: Any, capsys: pytest.CaptureFixture[str]) -> None:
    for module in ("BiasSpectr", "ZSpectr", "AutoApproach"):
        ask(client, f"{module}_Open")
    for getter in (name for name in FUNCTIONS if name.endswith("Get") and name not in MISREAD):
        wanted = len(signature(getattr(Client, getter)).parameters) - 1
        arguments = [[0], 0] if getter == "Signals_ValsGet" else [0] * wanted
        error, *_ = getattr(client, getter)(*arguments)
        assert bool(error) == (getter.partition("_")[0] not in ALIVE), (getter, error)
        assert not error or error.endswith("Module not available"), error
    capsys.readouterr()


@SEEN
def test_client_takes_a_scan_with_a_nanonis_file(client: Any) -> None:
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


def test_client_stops_a_scan_which_ends_the_wait(client: Any) -> None:
    ask(client, "Scan_BufferSet", [0], 512, 512)
    ask(client, "Scan_Action", 0, 1)
    assert ask(client, "Scan_StatusGet") == [1]
    assert ask(client, "Scan_WaitEndOfScan", 100)[0] == 1
    ask(client, "Scan_Action", 1, 0)
    assert ask(client, "Scan_StatusGet") == [0]


@pytest.mark.parametrize("clips_frames", [False, True])
def test_frame_beyond_the_range_is_kept_or_clipped(tmp_path: Path, *, clips_frames: bool) -> None:
    # results T2
    with connected(tmp_path, 100.0, range_m=1e-6, clips_frames=clips_frames) as client:
        ask(client, "Scan_FrameSet", 4e-7, 0.0, 5e-7, 2e-6, 0.0)
        frame = ask(client, "Scan_FrameGet")
        ask(client, "Scan_BufferSet", [14], 16, 8)
        ask(client, "Scan_Action", 0, 1)
        ask(client, "Scan_WaitEndOfScan", -1)
        values = ask(client, "Scan_FrameDataGrab", 14, 1)[4]
    expected = [2.5e-7, 0.0, 5e-7, 1e-6, 0.0] if clips_frames else [4e-7, 0.0, 5e-7, 2e-6, 0.0]
    assert frame == pytest.approx(expected)
    (file,) = tmp_path.glob("*.sxm")
    region = read(file).scans[0].region
    assert region.center_m == pytest.approx(expected[:2])
    is_at_edge = np.ptp(np.concatenate([values[:2, -5:], values[-2:, -5:]], axis=1)) < 1e-10
    assert is_at_edge is not clips_frames


@pytest.mark.parametrize("unscanned", ["nan", "zeros"])
def test_rows_not_yet_scanned_are_in_memory_as_set_and_missing_in_files(tmp_path: Path, unscanned: str) -> None:
    # results Z1, T1
    def is_missing(values: Any) -> Any:
        return np.isnan(values) if unscanned == "nan" else np.equal(values, 0.0)

    with connected(tmp_path, 100.0, unscanned=unscanned) as client:
        ask(client, "Scan_BufferSet", [0, 14], 16, 8)
        empty = ask(client, "Scan_FrameDataGrab", 14, 1)[4]
        ask(client, "Scan_SpeedSet", 1e-8, 1e-8, 100.0, 100.0, 1, 1.0)  # 2 real seconds a line
        ask(client, "Scan_Action", 0, 1)
        deadline_s = time.monotonic() + DEADLINE_S
        while is_missing(running := ask(client, "Scan_FrameDataGrab", 14, 0)[4]).all():
            assert time.monotonic() < deadline_s
        ask(client, "Scan_Action", 1, 0)
        stopped = ask(client, "Scan_FrameDataGrab", 14, 1)[4]
        ask(client, "Scan_Save", 1, -1)
    for values in (empty, running, stopped):
        missing = is_missing(values)
        assert missing.all(axis=1).tolist() == missing.any(axis=1).tolist()
    assert is_missing(empty).all()
    (file,) = tmp_path.glob("*.sxm")
    saved = read(file).scans[2]
    assert saved.channel == "Z Forward"
    scanned = ~is_missing(stopped)[::-1]
    assert 0 < scanned.sum() < scanned.size
    assert np.array_equal(np.isfinite(saved.values), scanned)


@pytest.mark.parametrize("reads", ["off", "on"])
@pytest.mark.parametrize("module", ["BiasSpectr", "ZSpectr"])
def test_z_controller_is_held_until_after_the_end_of_a_spectrum(tmp_path: Path, module: str, reads: str) -> None:
    held = [0], [3]
    if reads == "on":
        held = [1], [2]
    with connected(tmp_path, 100.0, feedback={"hold_s": 100.0, "hold_reads": reads}) as client:

        def switch() -> tuple[list[Any], list[Any]]:
            return ask(client, "ZCtrl_OnOffGet"), ask(client, "ZCtrl_StatusGet")

        assert switch() == ([1], [2])
        ask(client, f"{module}_Open")
        ask(client, f"{module}_Start", 0, "curve")
        assert switch() == held
        ask(client, f"{module}_Stop")
        ask(client, f"{module}_Start", 1, "curve")  # answered at the reported end
        assert switch() == held
        deadline_s = time.monotonic() + DEADLINE_S
        while switch() != ([1], [2]):
            assert time.monotonic() < deadline_s


def test_z_controller_switched_off_in_the_hold_stays_off(tmp_path: Path) -> None:
    with connected(tmp_path, 100.0, feedback={"hold_s": 20.0, "hold_reads": "on"}) as client:
        ask(client, "BiasSpectr_Open")
        ask(client, "BiasSpectr_Start", 1, "curve")
        ask(client, "ZCtrl_OnOffSet", 0)
        ask(client, "BiasSpectr_Start", 1, "curve")
        assert (ask(client, "ZCtrl_OnOffGet"), ask(client, "ZCtrl_StatusGet")) == ([0], [1])


@pytest.mark.parametrize(("module", "first"), [("BiasSpectr", "Bias calc (V)"), ("ZSpectr", "Z rel (m)")])
def test_client_takes_a_spectrum_with_a_row_for_each_channel(client: Any, module: str, first: str) -> None:
    # As in the client's examples.
    ask(client, f"{module}_Open")
    _, count, names, rows, _, values, *_ = ask(client, f"{module}_Start", 1, "curve")
    assert (names[0], rows) == (first, count)
    (spectrum,) = read(client.folder / "curve00001.dat").spectra
    np.testing.assert_allclose(values.T, spectrum.values, rtol=1e-4, atol=1e-18)


@SEEN
@pytest.mark.parametrize("module", ["BiasSpectr", "ZSpectr"])
def test_client_stops_a_spectrum_which_has_no_file(client: Any, module: str) -> None:
    ask(client, f"{module}_Open")
    ask(client, f"{module}_Start", 0, "curve")
    ask(client, f"{module}_Stop")
    assert not list(client.folder.glob("curve*"))
    if module == "ZSpectr":  # it can't read the other's status
        assert ask(client, "ZSpectr_StatusGet") == [0]


def test_spectrum_has_the_set_sweep_and_points(client: Any) -> None:
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
    (saved,) = read(client.folder / "curve00002.dat").spectra
    assert len(saved.values) == 31


def test_client_stops_a_moving_tip(client: Any) -> None:
    ask(client, "FolMe_SpeedSet", 1e-9, 1)
    ask(client, "FolMe_XYPosSet", 500e-9, 0.0, 0)
    ask(client, "FolMe_Stop")
    stopped = ask(client, "FolMe_XYPosGet", 1)
    assert 0.0 <= stopped[0] < 400e-9
    assert ask(client, "FolMe_XYPosGet", 1) == stopped
    assert ask(client, "Scan_XYPosGet", 1) == pytest.approx(stopped, rel=1e-6)


def test_client_switches_the_z_controller_with_a_delay(client: Any) -> None:
    for on in (0, 1):
        ask(client, "ZCtrl_OnOffSet", on)
        until_s = time.monotonic() + DEADLINE_S
        while ask(client, "ZCtrl_OnOffGet") != [on]:
            assert time.monotonic() < until_s
        assert ask(client, "ZCtrl_StatusGet") == [2 if on else 1]


def test_client_sets_z_only_with_the_controller_off(client: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert client.ZCtrl_ZPosSet(1e-9)[0]
    assert "The following error appeared" in capsys.readouterr().out
    ask(client, "ZCtrl_OnOffSet", 0)
    until_s = time.monotonic() + DEADLINE_S
    while ask(client, "ZCtrl_OnOffGet") != [0]:
        assert time.monotonic() < until_s
    ask(client, "ZCtrl_ZPosSet", 1e-9)
    assert ask(client, "ZCtrl_ZPosGet") == pytest.approx([1e-9], abs=NOISE_M)


def test_client_compensates_drift(client: Any) -> None:
    on, off = 1, 2
    ask(client, "Piezo_DriftCompSet", on, 1e-11, -2e-11, 0.0, 10.0)
    assert ask(client, "Piezo_DriftCompGet") == pytest.approx([1, 1e-11, -2e-11, 0.0, 0, 0, 0, 10.0], rel=1e-6)
    ask(client, "Piezo_DriftCompSet", off, 1e-11, -2e-11, 0.0, 10.0)
    assert ask(client, "Piezo_DriftCompGet")[0] == 0


def test_tracked_atom_measures_drift_and_rotation(tmp_path: Path) -> None:
    # A minute of tracking is skipped: a millimetre from the centre of rotation, the sample moves by 10 pm/s.
    turns = {"rotation_rad_per_s": 1e-8, "about_m": [-1e-3, 0.0], "velocity_m_per_s": [3e-12, 0.0, 1e-12]}
    with connected(tmp_path, 1e5, drift=turns) as client:
        ask(client, "AtomTrack_QuickCompStart", 1)
        on, *velocity_m_s = ask(client, "Piezo_DriftCompGet")[:4]
    assert on == 1
    assert velocity_m_s == pytest.approx([3e-12, 10e-12, 1e-12], abs=0.2e-12)


def test_client_saves_a_stopped_scan(client: Any) -> None:
    ask(client, "Scan_PropsSet", 2, 2, 3, "part_", "", [], 0)
    ask(client, "Scan_BufferSet", [0, 14], 64, 64)
    ask(client, "Scan_Action", 0, 1)
    ask(client, "Scan_Action", 2, 0)
    ask(client, "Scan_Action", 3, 0)
    ask(client, "Scan_Action", 1, 0)
    assert ask(client, "Scan_Save", 1, -1) == [0]
    assert [path.name for path in client.folder.glob("*.sxm")] == ["part_001.sxm"]


def test_client_moves_the_tip_and_waits_for_arrival(client: Any) -> None:
    ask(client, "FolMe_XYPosSet", 50e-9, -30e-9, 1)
    assert ask(client, "FolMe_XYPosGet", 1) == [50e-9, -30e-9]


def test_client_reads_lists_of_names_and_values(client: Any) -> None:
    *_, names = ask(client, "Signals_NamesGet")
    assert len(names) == 128
    assert (names[0], names[14]) == ("Current (A)", "Z (m)")
    ask(client, "Bias_Set", 0.5)
    _, values = ask(client, "Signals_ValsGet", [0, names.index("Bias (V)")], 1)
    current_a, bias_v = flat(values)
    assert (current_a != 0.0, bias_v) == (True, 0.5)
    *_, controllers, active = ask(client, "ZCtrl_CtrlListGet")
    assert (controllers, active) == (["log Current"], 0)
    assert ask(client, "Util_SessionPathGet")[1] == str(client.folder)


@SEEN
def test_client_withdraws_pulses_shapes_and_walks(client: Any) -> None:
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


def test_client_receives_a_text_for_each_refusal(client: Any, capsys: pytest.CaptureFixture[str]) -> None:
    for function, arguments in (
        ("Bias_Set", (99.0,)),
        ("Scan_FrameDataGrab", (99, 1)),
        ("Scan_FrameSet", (0.0, 0.0, 1e-17, 1e-17, 0.0)),
        ("Laser_PowerGet", ()),
    ):
        error, *_ = getattr(client, function)(*arguments)
        assert error
    assert "The following error appeared" in capsys.readouterr().out


# --- what lives ---


def measured(client: Any) -> tuple[float, float, float]:
    """Return mean and standard deviation of the current, and the mean frequency shift."""
    current, noise_a = mean_and_noise(client, "Current_Get")
    names = ask(client, "Signals_NamesGet")[-1]
    return current, noise_a, mean_and_noise(client, "Signals_ValGet", names.index("OC M1 Freq. Shift (Hz)"), 1)[0]


def mean_and_noise(client: Any, getter: str, *arguments: Any, count: int = 30) -> tuple[float, float]:
    values = [ask(client, getter, *arguments)[0] for _ in range(count)]
    return float(np.mean(values)), float(np.std(values))


def test_current_and_z_depend_on_contact(client: Any) -> None:
    for getter, arguments in (("Current_Get", ()), ("Signals_ValGet", (0, 1))):
        at_sample, noise = mean_and_noise(client, getter, *arguments)
        assert noise > 0.0
        assert at_sample > 5e-12
    z_m, z_noise_m = mean_and_noise(client, "ZCtrl_ZPosGet")
    assert 0.0 < z_noise_m < NOISE_M
    assert mean_and_noise(client, "Signals_ValGet", 14, 1)[0] == pytest.approx(z_m, abs=NOISE_M)
    ask(client, "ZCtrl_Withdraw", 1, -1)
    assert abs(mean_and_noise(client, "Current_Get")[0]) < 1e-13
    upper_end_m = ask(client, "Piezo_RangeGet")[2] / 2
    assert mean_and_noise(client, "ZCtrl_ZPosGet")[0] == pytest.approx(upper_end_m, abs=NOISE_M)


def test_tip_finds_features_where_a_scan_shows_them(client: Any) -> None:
    ask(client, "Scan_FrameSet", 0.0, 0.0, 10e-9, 10e-9, 0.0)
    ask(client, "Scan_BufferSet", [14], 32, 32)
    ask(client, "Scan_Action", 0, 1)
    ask(client, "Scan_WaitEndOfScan", -1)
    values = ask(client, "Scan_FrameDataGrab", 14, 1)[4]
    ask(client, "FolMe_XYPosSet", 0.0, 0.0, 1)
    scanned_m = float(np.mean(values[15:17, 15:17]))
    assert mean_and_noise(client, "ZCtrl_ZPosGet")[0] == pytest.approx(scanned_m, abs=2 * NOISE_M)


def test_the_current_falls_when_the_tip_is_lifted_with_the_controller_off(client: Any) -> None:
    before, _ = mean_and_noise(client, "Current_Get")
    ask(client, "ZCtrl_TipLiftSet", 20e-9)
    ask(client, "ZCtrl_OnOffSet", 0)
    assert mean_and_noise(client, "Current_Get")[0] < before / 5


@pytest.mark.parametrize("bias_v", [0.1, 0.25, 1.0, -1.0])
def test_the_current_is_the_setpoint_at_any_bias(tmp_path: Path, bias_v: float) -> None:
    # With the emulator's default settings.
    with connected(tmp_path, 100.0, surface="steps") as client:
        ask(client, "Bias_Set", bias_v)
        for setpoint_a in (ask(client, "ZCtrl_SetpntGet")[0], 50e-12, 1e-9):
            ask(client, "ZCtrl_SetpntSet", setpoint_a)
            current_a, _, _ = measured(client)
            assert current_a == pytest.approx(math.copysign(setpoint_a, bias_v), abs=1e-12)
            assert 10e-12 < setpoint_a < 10e-9


def test_frequency_shift_current_and_z_show_the_state_of_the_tip(tmp_path: Path) -> None:
    # A tip check must find the difference, and a withdrawn tip must not pass it.
    found = {}
    for condition in ("sharp", "blunt", "double", "contaminated"):
        with connected(tmp_path / condition, 100.0, surface="steps", tip={"condition": condition}) as client:
            found[condition] = *measured(client), mean_and_noise(client, "ZCtrl_ZPosGet")[0]
            ask(client, "ZCtrl_Withdraw", 1, -1)
            away = measured(client)
            assert abs(away[0]) < 1e-13
            assert abs(away[2]) < 0.1
    sharp_hz, sharp_m = found["sharp"][2:]
    assert -10.0 < sharp_hz < -1.0
    assert found["blunt"][2] < 3.0 * sharp_hz
    assert found["double"][2] < 1.2 * sharp_hz
    assert found["contaminated"][2] < 1.5 * sharp_hz
    assert found["contaminated"][1] > 10.0 * found["sharp"][1], "the current flickers"
    assert all(abs(found[worse][3] - sharp_m) > 3e-11 for worse in ("blunt", "double"))


# --- settings and their effects ---


@pytest.mark.parametrize(
    ("setter", "getter", "belongs_to", "sent", "got"),
    [
        ("SafeTip_OnOffSet", "SafeTip_OnOffGet", [], [1], [1]),
        ("SafeTip_OnOffSet", "SafeTip_OnOffGet", [], [2], [0]),
        ("BiasSpectr_AdvPropsSet", "BiasSpectr_AdvPropsGet", [], [2, 0, 1, 2], [0, 1, 1, 0]),
        ("ZSpectr_AdvPropsSet", "ZSpectr_AdvPropsGet", [], [0.5, 1, 2, 0], [0.5, 1, 0, 0]),
        ("TipShaper_PropsSet", "TipShaper_PropsGet", [], [0.1, 2, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2], [0.1, 0]),
        ("ZCtrl_HomePropsSet", "ZCtrl_HomePropsGet", [], [2, 1e-8], [1, 1e-8]),
        ("LockIn_ModAmpSet", "LockIn_ModAmpGet", [2], [0.05], [0.05]),
        ("LockIn_ModOnOffSet", "LockIn_ModOnOffGet", [1], [1], [1]),
        ("LockIn_ModPhasFreqSet", "LockIn_ModPhasFreqGet", [1], [873.5], [873.5]),
        ("LockIn_DemodLPFilterSet", "LockIn_DemodLPFilterGet", [1], [4, 100.0], [4, 100.0]),
        ("PLL_CenterFreqSet", "PLL_CenterFreqGet", [1], [31234.5], [31234.5]),
        ("PLL_AmpCtrlSetpntSet", "PLL_AmpCtrlSetpntGet", [1], [5e-11], [5e-11]),
        ("PLL_AmpCtrlGainSet", "PLL_AmpCtrlGainGet", [1], [2.0, 0.5], [2.0, 0.5, 4.0]),
        ("UserOut_ModeSet", "UserOut_ModeGet", [3], [2], [2]),
        ("Motor_FreqAmpSet", "Motor_FreqAmpGet", [], [900.0, 120.0, 0], [900.0, 120.0]),
        ("Bias_RangeSet", "Bias_RangeGet", [], [1], [15, 2, ["10 V", "1 V"], 1]),
        ("Pattern_GridSet", "Pattern_GridGet", [], [1, 4, 5, 0, 1e-9, 2e-9, 3e-8, 4e-8, 9.0], [4, 5, 1e-9, 2e-9, 3e-8]),
        ("Pattern_CloudSet", "Pattern_CloudGet", [], [1, 2, [1e-9, 2e-9], [3e-9, 4e-9]], [2]),
        ("AtomTrack_CtrlSet", "AtomTrack_StatusGet", [1], [1], [1]),
    ],
)  # fmt: skip
def test_getters_return_values_in_their_own_form(
    client: Any, setter: str, getter: str, belongs_to: list[Any], sent: list[Any], got: list[Any]
) -> None:
    ask(client, setter, *belongs_to, *sent)
    found = ask(client, getter, *([0] if getter == "Motor_FreqAmpGet" else belongs_to))
    for value, wanted in zip(found, got, strict=False):
        assert value == (pytest.approx(wanted, rel=1e-6) if isinstance(wanted, float) else wanted)


@SEEN
def test_stopped_motor_stays_at_its_place(client: Any) -> None:
    ask(client, "Motor_StartMove", 4, 60_000, 0, 0)
    ask(client, "Motor_StopMove")
    stopped = ask(client, "Motor_PosGet", 0, 500)
    assert stopped[2] < 60_000 * 100e-9
    assert ask(client, "Motor_PosGet", 0, 500) == stopped
    ask(client, "Motor_StartMove", 4, 1, 0, 1)  # it is free again


def test_spectrum_has_the_chosen_channels_and_mean_of_sweeps(client: Any) -> None:
    ask(client, "BiasSpectr_Open")
    no_change, off = 0, 2
    ask(client, "BiasSpectr_ChsSet", [0, 14])
    noise = []
    for sweeps in (1, 16):
        ask(client, "BiasSpectr_PropsSet", no_change, sweeps, off, 64, 0.0, no_change, no_change)
        curves = []
        for _ in range(4):
            _, _, names, _, _, values, count, parameters = ask(client, "BiasSpectr_Start", 1, "curve")
            curves.append(values[1])
        noise.append(np.std(curves, axis=0).mean())
    assert names == ["Bias calc (V)", "Current (A)", "Z (m)"]
    assert (count, len(parameters)) == (3, 3)
    assert noise[1] < 0.6 * noise[0]
    assert ask(client, "BiasSpectr_ChsGet")[1] == [(0,), (14,)]
    assert client.BiasSpectr_ChsSet([500])[0]


def test_each_base_name_is_numbered_and_a_valid_file_name(client: Any) -> None:
    ask(client, "BiasSpectr_Open")
    for name in ("one", "one", "other", ""):
        ask(client, "BiasSpectr_Start", 1, name)
    assert {path.name for path in client.folder.glob("*.dat")} == {
        "one00001.dat", "one00002.dat", "other00001.dat", "other00002.dat",
    }  # fmt: skip
    for name in ("../outside", "a/b", "nul\0byte", "C:\\x"):
        assert client.BiasSpectr_Start(1, name)[0]
        assert client.Scan_PropsSet(0, 0, 0, name, "", [], 0)[0]


@SEEN
def test_the_tip_goes_to_the_centre_of_the_frame(client: Any) -> None:
    ask(client, "Scan_FrameSet", 40e-9, -30e-9, 10e-9, 10e-9, 0.0)
    ask(client, "Scan_Action", 6, 0)
    until_s = time.monotonic() + DEADLINE_S
    while ask(client, "FolMe_XYPosGet", 1) != pytest.approx([40e-9, -30e-9]):
        assert time.monotonic() < until_s


def test_a_grid_of_spectra_takes_its_time_and_can_be_stopped(client: Any) -> None:
    ask(client, "Pattern_ExpOpen")
    ask(client, "Pattern_GridSet", 1, 100, 100, 0, 0.0, 0.0, 1e-8, 1e-8, 0.0)
    ask(client, "Pattern_ExpStart", 1)
    assert ask(client, "Pattern_ExpStatusGet") == [1]
    ask(client, "Pattern_ExpStop")
    assert ask(client, "Pattern_ExpStatusGet") == [0]


def test_repeated_waits_find_the_end_of_a_scan_at_any_clock_speed(client: Any) -> None:
    # A scan may end before the wait, or between two waits: a hundred times as often as in real time.
    ask(client, "Scan_BufferSet", [0], 16, 16)
    ask(client, "Scan_SpeedSet", 1e-6, 1e-6, 0.05, 0.05, 2, 1.0)
    for _ in range(3):
        ask(client, "Scan_Action", 0, 1)
        while ask(client, "Scan_StatusGet") == [1]:
            pass
        assert ask(client, "Scan_WaitEndOfScan", 5000)[0] == 0
    assert ask(client, "Scan_WaitEndOfScan", 1)[0] == 1, "an end is reported once"
    started_s = time.monotonic()
    assert ask(client, "Scan_WaitEndOfScan", 500)[0] == 1
    assert time.monotonic() - started_s >= 0.5, "a client's patience is in real time"


def test_signals_are_logged_on_a_port_of_their_own(tmp_path: Path) -> None:
    emulator = NanonisEmulator(port=0, surface="lattice")
    with emulator.running(tmp_path, ExperimentClock.starting_now(speed=1.0)) as address:
        host, port = address.split(":")
        with socket.create_connection((host, int(port)), timeout=DEADLINE_S) as connection:
            client = Client(connection)
            assert ask(client, "TCPLog_StatusGet") == [0]
            with socket.create_connection((host, emulator.logger_port), timeout=DEADLINE_S) as stream:
                until_s = time.monotonic() + DEADLINE_S
                while ask(client, "TCPLog_StatusGet") != [1]:
                    assert time.monotonic() < until_s
                ask(client, "TCPLog_ChsSet", 2, [0, 1])
                ask(client, "TCPLog_OversamplSet", 20)
                ask(client, "TCPLog_Start")
                reader = stream.makefile("rb")
                frames = [struct.unpack(">ifqH2f", reader.read(18 + 8)) for _ in range(20)]
                assert ask(client, "TCPLog_StatusGet") == [4]
                ask(client, "TCPLog_Stop")
                assert ask(client, "TCPLog_StatusGet") == [1]
    assert {frame[:2] + frame[3:4] for frame in frames} == {(2, 20.0, 4)}
    counters = [frame[2] for frame in frames]
    assert counters == sorted(set(counters))
    currents = [frame[4] for frame in frames]
    assert np.mean(currents) > 5e-12
    assert len(set(currents)) > 10


@pytest.mark.parametrize(
    "example",
    ["BiasPulsesAtVariousZ", "BiasSpectroscopy", "BiasSpectroscopy_MultiSegment", "CustomBiasSweep"],
)
def test_the_makers_own_examples_run_as_they_are(
    example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Only the port is changed.
    spec = importlib.util.find_spec("nanonis_spm_examples")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    emulator = NanonisEmulator(port=0, surface="lattice")
    with emulator.running(tmp_path, ExperimentClock.starting_now(speed=50.0)) as address:
        connect, port = socket.socket.connect, int(address.split(":")[1])
        monkeypatch.setattr(socket.socket, "connect", lambda made, _: connect(made, ("127.0.0.1", port)))
        runpy.run_path(str(Path(spec.submodule_search_locations[0]) / f"Example_{example}.py"), run_name="__main__")
    told = capsys.readouterr().out
    assert "No error messages" in told
    assert "The following error appeared" not in told
