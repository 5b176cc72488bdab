"""The emulated GXSM as other programs see it, compared with observations of the real one."""

from __future__ import annotations

import itertools
import math
import os
import select
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from deadlines import DEADLINE_S
from tests.plugins.gxsm.gxsm_bench import Bench, hold_scan, scan_to_line, scan_until_line, until
from tests.plugins.gxsm.raw_clients import MemoryClient, SocketClient, client

from afspm import read
from afspm.emulation import ControllerClock, Crashed, Faults
from afspm.plugins.gxsm.emulator.block import FAULT_KINDS, SharedMemoryBlock
from afspm.plugins.gxsm.emulator.file_writer import GxsmFileWriter

Make = Callable[..., Bench]
KINDS: list[dict[str, Any]] = [{"version": 3}, {"version": 4}, {"version": 4, "transport": "shm"}]
KIND_IDS = ["gxsm3", "gxsm4", "gxsm4-shm"]
NON_CONTACT: dict[str, Any] = {"feedback": {"mode": "frequency-shift", "setpoint": -20.0}}
SEEN = 2.0
"""A speed at which what takes a second is seen while it lasts, on a busy computer too."""


@contextmanager
def calling(made: Bench) -> Iterator[SocketClient | MemoryClient]:
    caller = client(made.address)
    try:
        yield caller
    finally:
        caller.close()


def small(gxsm: SocketClient | MemoryClient) -> None:
    for ref, value in {"PointsX": "16", "PointsY": "8", "RangeX": "1000", "RangeY": "500"}.items():
        assert gxsm.call("set", ref, value) == 0


def bits(gxsm: SocketClient | MemoryClient) -> int:
    return int(gxsm.call("rtquery", "s")[0])


def not_converted(gxsm: SocketClient | MemoryClient, method: str, *arguments: Any) -> bool:
    """Return True if GXSM rejects arguments: an error in its console, -1 through shared memory."""
    if isinstance(gxsm, MemoryClient):
        return bool(gxsm.call(method, *arguments) == -1)
    with pytest.raises(RuntimeError, match="SystemError"):
        gxsm.call(method, *arguments)
    return True


@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
def test_a_scan_from_first_to_last(bench: Make, kind: dict[str, Any]) -> None:
    made = bench(speed=SEEN, **kind)
    with calling(made) as gxsm:
        small(gxsm)
        gxsm.call("set", "OffsetX", "200")
        gxsm.call("set", "Rotation", "15")
        gxsm.call("action", "UNCHECK-MainAutoSave")
        assert gxsm.call("startscan") == 0
        until(made, lambda: bool(bits(gxsm) & 2))
        scanning = made.emulator.program.scan.activity
        assert scanning is not None
        assert made.clock.now_s() >= scanning.start_s + 0.15, "it takes a moment to be seen"
        gxsm.call("set", "RangeX", "2000")
        until(made, lambda: not bits(gxsm) & 2)
        assert list(gxsm.call("get_geometry", 0)) == [1000.0, 500.0, 200.0, 0.0, 15.0], "of the scan, not of the next"
        assert repr(list(gxsm.call("get_dimensions", 0))) == "[16, 8, 1, 1]"
        assert gxsm.call("get_differentials", 0)[3] == 10.0
        assert gxsm.call("get_slice", 0, 0, 0, 8, 1) == -1, "beyond the last row"
        image = gxsm.call("get_slice", 0, 0, 0, 0, 8)
        assert gxsm.call("autosave") == 7
        told = gxsm.call("chfname", 0)
        assert told.startswith("./scan001-"), "where GXSM was started, whose user has chosen no folder"
        path = made.data / told
        until(made, lambda: path.exists() and _readable(path))
        (scan,) = read(path).scans
        np.testing.assert_allclose(scan.values[::-1] * 1e10, image, rtol=1e-6)
        assert scan.region.center_m == pytest.approx((20e-9, 0.0))
        assert math.degrees(scan.region.angle_rad) == pytest.approx(-15.0)
        gxsm.call("autosave")
        again = Path(gxsm.call("chfname", 0))
        assert again.name[4:7] == "002", "it is saved again"


def _readable(path: Path) -> bool:
    try:
        return bool(read(path).scans)
    except Exception:  # an incomplete file can make its reader raise any error
        return False


@pytest.mark.parametrize("fault", ["nan", "error", "wrong-type"])
def test_faults_of_answers_spare_the_scripts_own_look(bench: Make, fault: str) -> None:
    made = bench()
    made.strike(fault)
    found: list[object] = []
    made.at_panel(lambda emulator: found.append(emulator.answer("get", ("script-control",))))
    assert found == [1.0], "the script would end"


@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
def test_set_never_reports_a_refusal(bench: Make, kind: dict[str, Any]) -> None:
    made = bench(user_unit="nm", **kind)
    with calling(made) as gxsm:
        assert gxsm.call("set", "RangeX", "30.5") == 0
        assert gxsm.call("get", "RangeX") == 30.5
        assert gxsm.call("get", "RangeY") == 30.5, "set along with it"
        assert gxsm.call("gets", "RangeX") == "30.5 nm    "
        assert gxsm.call("gets", "Rang") == "30.5 nm    ", "the first that begins so"
        assert gxsm.call("gets", "Rotation") == "     0 °"
        assert gxsm.call("get", "StepsX") == pytest.approx(30.5 / 63), "of range and points"
        assert gxsm.call("set", "RangeX", "1e9") == 0
        assert gxsm.call("get", "RangeX") == 30.5
        assert made.emulator.program.dialogs == ["Valid Range of RangeX: 0.0 to 40000.0"]
        assert gxsm.call("set", "RangeX", "1.5nm") == 0
        assert gxsm.call("get", "RangeX") == 1.5, "as much of a text as is a number"
        assert gxsm.call("set", "PointsX", "33.7") == 0
        assert gxsm.call("get", "PointsX") == 33.0
        assert gxsm.call("set", "OffsetX", "abc") == 0
        assert gxsm.call("get", "OffsetX") == 0.0
        for nothing in ("abc", "", "0"):
            assert gxsm.call("set", "RangeX", nothing) == 0
            assert gxsm.call("get", "RangeX") == pytest.approx(0.0422), "a step of its converter, never 0"
        assert gxsm.call("set", "RangeX", "1.5") == 0
        assert gxsm.call("set", "nonsense", "1") == 0
        assert gxsm.call("gets", "nonsense") == "ERROR"
        assert not_converted(gxsm, "set", "RangeX", 12.5)
        assert gxsm.call("moveto_scan_xy", 10.0, 0.0) == -1, "in ångström in any unit: 15 from side to side"
        assert gxsm.call("moveto_scan_xy", 7.0, 0.0) == 0
        assert not_converted(gxsm, "moveto_scan_xy", "7", "0")
        assert not_converted(gxsm, "set")


def test_reported_names_may_be_existing_files_until_saving(bench: Make) -> None:
    # In the first moments of a scan, the names of the previous scan are reported.
    made = bench(speed=SEEN)
    for name in ("scan001-M-Xp-ZSmTopo.nc", "scan002-M-Xp-ZSmTopo.nc"):
        (made.data / name).write_bytes(b"of last year")
    with calling(made) as gxsm:
        small(gxsm)

        def reported(channel: int) -> str:
            return Path(gxsm.call("chfname", channel)).name

        gxsm.call("startscan")
        until(made, lambda: bool(bits(gxsm) & 2))
        assert reported(0) == "scan001-M-Xp-ZSmTopo.nc", "which is there already"
        until(made, lambda: not bits(gxsm) & 2)
        until(made, lambda: reported(0) == "scan003-M-Xp-ZSmTopo.nc")
        assert reported(2) == "scan001-Xp-ImTunnel.nc", "each channel counts by itself"
        until(made, lambda: len(list(made.data.glob("*.nc"))) == 6)
        gxsm.call("startscan")
        saved = reported(0)
        started = made.emulator.program.scan.activity
        assert started is not None
        assert saved == "scan003-M-Xp-ZSmTopo.nc" or made.clock.now_s() > started.start_s + 0.04
        until(made, lambda: reported(0) == "scan004-M-Xp-ZSmTopo.nc")
        assert gxsm.call("chfname", 4) == "EE: invalid channel"


def test_stopped_scan_is_saved_with_rows_of_the_previous_one(bench: Make) -> None:
    made = bench(speed=SEEN)
    with calling(made) as gxsm:
        small(gxsm)
        assert gxsm.call("chfname", 0) == "EE: invalid channel"
        made.at_panel(lambda emulator: hold_scan(emulator.program, 1, 2, 3))
        gxsm.call("startscan")
        until(made, lambda: bool(bits(gxsm) & 2))
        made.at_panel(lambda emulator: scan_to_line(emulator.program, 4))
        assert gxsm.call("y_current") == 3
        gxsm.call("stopscan")
        assert not bits(gxsm) & 2, "free at once"
        assert gxsm.call("y_current") == 7, "where it did not come to"
        path = made.data / "scan001-M-Xp-ZSmTopo.nc"
        until(made, lambda: path.exists() and _readable(path))
        (scan,) = read(path).scans
        there = np.asarray(np.isfinite(scan.values).all(axis=1))
        assert there[-3:].all(), "from the top"
        assert not there[0]
        assert gxsm.call("get_slice", 0, 0, 0, 7, 1).tolist() == [[0.0] * 16]
        gxsm.call("startscan")
        assert gxsm.call("y_current") == 7, "until the first line is in"
        made.at_panel(lambda emulator: scan_until_line(emulator.program, 1))
        until(made, lambda: not bits(gxsm) & 2 and gxsm.call("rtquery", "s")[0] == 1.0)
        until(made, lambda: (made.data / "scan002-M-Xp-ZSmTopo.nc").exists())
        before = gxsm.call("get_slice", 0, 0, 0, 0, 8)
        gxsm.call("set", "PointsY", "10")
        gxsm.call("set", "PointsX", "12")
        gxsm.call("set", "PointsY", "10")
        gxsm.call("startscan")
        until(made, lambda: bool(bits(gxsm) & 2))
        made.at_panel(lambda emulator: scan_to_line(emulator.program, 4))
        assert gxsm.call("y_current") == 3
        gxsm.call("stopscan")
        now = gxsm.call("get_slice", 0, 0, 0, 0, 10)
        assert not np.array_equal(now[0], before[0, :12])
        np.testing.assert_array_equal(now[6:8], before[6:, :12])
        assert not now[8:].any(), "rows that there were none of"


def test_unknown_parameters_are_minus_infinity_in_4_and_garbage_in_3(bench: Make) -> None:
    with calling(bench(version=4)) as gxsm:
        assert gxsm.call("get", "dsp-nonsense") == -math.inf
    with calling(bench(version=3)) as gxsm:
        assert gxsm.call("get", "dsp-nonsense") == "I\x025"


def test_a_decimal_comma_cuts_numbers(bench: Make) -> None:
    with calling(bench(decimal_comma=True)) as gxsm:
        gxsm.call("set", "RangeX", "12.75")
        assert gxsm.call("get", "RangeX") == 12.0
        gxsm.call("set", "RangeX", "12,75")
        assert gxsm.call("get", "RangeX") == 12.75


def test_status_bits_of_the_redpitaya_differ(bench: Make) -> None:
    made = bench(speed=SEEN, card="RPSPMC")
    with calling(made) as gxsm:
        small(gxsm)
        assert bits(gxsm) == 1
        gxsm.call("action", "DSP_VP_IV_EXECUTE")
        until(made, lambda: bits(gxsm) == 2)  # the feedback is held
        until(made, lambda: bits(gxsm) == 1)
        gxsm.call("startscan")
        until(made, lambda: bits(gxsm) == 3)
        until(made, lambda: bits(gxsm) == 17)
        assert "DSP_VP_ABORT_EXECUTE" not in gxsm.call("list_actions")


@pytest.mark.parametrize("version", [3, 4])
def test_a_repeated_scan_has_its_own_number_and_is_never_seen_to_end(bench: Make, version: int) -> None:
    made = bench(speed=SEEN, version=version, auto_save=False)
    with calling(made) as gxsm:
        small(gxsm)
        gxsm.call("action", "CHECK-SCAN-REPEAT")
        gxsm.call("startscan")
        until(made, lambda: bool(bits(gxsm) & 2))
        names = [gxsm.call("chfname", 0)]
        lines: list[int] = []
        while len(names) < 3:
            assert bits(gxsm) & 2
            lines.append(gxsm.call("y_current"))
            if gxsm.call("chfname", 0) != names[-1]:
                names.append(gxsm.call("chfname", 0))
        assert [name[6:9] for name in names] == ["001", "002", "003"]
        assert sum(later < line for line, later in itertools.pairwise(lines)) >= 1, "lines begin again"
        gxsm.call("stopscan")
        assert not bits(gxsm) & 2, "one that is stopped is not repeated"
        gxsm.call("startscan")
        until(made, lambda: bool(bits(gxsm) & 2))


@pytest.mark.parametrize("version", [3, 4])
def test_gxsms_own_simulator_has_its_own_names(bench: Make, version: int) -> None:
    made = bench(speed=SEEN, card="simulator", version=version, **({} if version == 3 else NON_CONTACT))
    with calling(made) as gxsm:
        assert gxsm.call("get", "sim-stm-speed") == 1.0
        assert gxsm.call("set", "sim-stm-speed", "0") == 0
        assert gxsm.call("get", "sim-stm-speed") == 1.0, "refused"
        gxsm.call("set", "sim-stm-speed", "4000")
        assert gxsm.call("gets", "sim-stm-speed") == "4000.00 px/s"
        gxsm.call("set", "PointsX", "20000")
        assert gxsm.call("get", "PointsY") == 20_000.0
        small(gxsm)
        assert gxsm.call("gets", "StepsX") == "66.667 Å    "
        refs = gxsm.call("list_refnames")
        assert any(ref.startswith("sim-stm-fbs-") for ref in refs) == (version == 3)
        assert any(ref.startswith("sim-config-adv-scan-slope-") for ref in refs) == (version == 3)
        gxsm.call("startscan")
        until(made, lambda: bool(bits(gxsm) & 2))
        assert not gxsm.call("chfname", 0).startswith("EE")
        names = [one.label for one in made.emulator.program.channels]
        assert names == (["Topo", "MIX1"] if version == 3 else ["ZS-Topo", "ZS-Topo", "I-Tunnel", "dFreq"])
        for code in ("S", "o", "O", "f", "p", "P"):
            assert abs(gxsm.call("rtquery", code)[0]) < 1e5
            assert gxsm.call("rtquery", code)[0] == 0.0 or abs(gxsm.call("rtquery", code)[0]) > 1e-300


def test_result_of_action_in_gxsm3_is_not_touched(bench: Make) -> None:
    with calling(bench(version=3)) as gxsm:
        assert gxsm.call("action", "CHECK-MainAutoSave") is None
        assert gxsm.call("action", "nonsense") is None


def test_bridge_passes_on_allowed_methods_only(bench: Make) -> None:
    made = bench()
    with calling(made) as gxsm:
        for method in ("waitscan", "load", "__class__", "signal"):
            with pytest.raises(RuntimeError, match=f"{method} is not a method that the bridge passes on"):
                gxsm.call(method)
        with calling(made) as other:
            assert other.call("y_current") == gxsm.call("y_current") == 0, "two clients at once"


PAGE = (
    b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/plain\r\nContent-Length: 40\r\n\r\n"
    b'["action", "UNCHECK-MainAutoSave"]\n["set", "RangeX", "12"]\n'
)


@pytest.mark.parametrize(
    "sent",
    [PAGE, b'["set", "RangeX", "12"]\n', b"0" * 64 + b'\n["set", "RangeX", "12"]\n', b'\n["set", "RangeX", "12"]\n'],
    ids=["a page", "no secret", "another", "nothing"],
)
def test_bridge_refuses_clients_without_the_secret(bench: Make, sent: bytes) -> None:
    made = bench()
    host, _, port = made.address.rpartition(":")
    with socket.create_connection((host, int(port)), 10.0) as stranger:
        stranger.sendall(sent)
        with suppress(ConnectionError):
            assert stranger.recv(1000) == b"", "no answer"
    with calling(made) as gxsm:
        assert gxsm.call("get", "RangeX") == 1e4
    assert made.emulator.program.panel.auto_save


@pytest.mark.parametrize("line", [b"Host: x", b"{}", b"[]", b"[1]", b'["get", {}]', b"[" * 9000, b"\xff"])
def test_bridge_disconnects_at_the_first_malformed_line(bench: Make, line: bytes) -> None:
    made = bench()
    with calling(made) as gxsm:
        assert isinstance(gxsm, SocketClient)
        assert gxsm.sent_away(line + b'\n["set", "RangeX", "12"]\n')
    with calling(made) as gxsm:
        assert gxsm.call("get", "RangeX") == 1e4


@pytest.mark.skipif(os.name == "nt", reason="permissions as Unix has them")
def test_other_users_can_not_read_the_secret(bench: Make) -> None:
    bench()
    file = Path("~/.afspm/gxsm-bridge-secret").expanduser()
    assert file.stat().st_mode & 0o777 == 0o600
    file.chmod(0o640)
    with pytest.raises(PermissionError, match="chmod 600"):
        bench()


def test_shared_memory_without_the_lock_mixes_answers_up(bench: Make) -> None:
    made = bench(transport="shm")
    one, other = (MemoryClient(made.address, locked=False) for _ in range(2))
    made.strike("wedge", duration_s=50.0)
    one.ask("get", "PointsX")
    other.ask("gets", "RangeX")
    one.answer()
    until(made, lambda: one.status() != 1)
    assert one.answer() == other.answer(), "the caller of each request is unknown"
    one.close()
    other.close()


def test_shared_memory_has_a_code_for_each_failure(bench: Make) -> None:
    with calling(bench(transport="shm")) as gxsm:
        with pytest.raises(RuntimeError, match="status -4"):
            gxsm.call("nonsense")
        assert gxsm.call("get") == -1, "and none for arguments that C does not convert"
        assert list(gxsm.call("rtquery")) == [0.0] * 3
        assert gxsm.call("get", "PointsX") == 64.0


def test_waiting_for_the_simulator_silences_gxsm_for_good(bench: Make) -> None:
    made = bench(transport="shm", card="simulator")
    gxsm = MemoryClient(made.address)
    gxsm.ask("waitscan")
    until(made, lambda: made.emulator.silent)
    gxsm.ask("get", "PointsX")
    made.at_panel(lambda emulator: None)
    assert gxsm.status() == 1
    gxsm.close()


def test_a_spectrum_and_its_event(bench: Make) -> None:
    made = bench(speed=SEEN)
    with calling(made) as gxsm:
        gxsm.call("set", "OffsetX", "70")
        gxsm.call("moveto_scan_xy", 50.0, 20.0)
        until(made, lambda: not bits(gxsm) & 16)
        gxsm.call("action", "DSP_VP_IV_EXECUTE")
        until(made, lambda: bool(bits(gxsm) & 8))
        until(made, lambda: not bits(gxsm) & 8)
        path = made.data / "scan001-VP001-VP.vpdata"
        until(made, lambda: path.exists() and b"END OF HEADER" in path.read_bytes())
        content = read(path)
        assert content.header["GXSM-Main-Offset"].startswith("X0=70 Ang"), "the offset, and not where it was taken"
        true = made.emulator.rig.spectrum
        assert true is not None
        assert true.position_m == pytest.approx((12e-9, 2e-9))
        np.testing.assert_allclose(content.spectra[0].values[:, 0], true.values[:, 0], rtol=1e-9)


@pytest.mark.parametrize("reads", ["off", "on"])
def test_feedback_is_held_until_after_the_end_of_a_spectrum(bench: Make, reads: str) -> None:
    made = bench(speed=20.0, feedback={"hold_s": 20.0, "hold_reads": reads})
    held = int(reads == "on")
    with calling(made) as gxsm:
        assert bits(gxsm) & 1
        gxsm.call("action", "DSP_VP_IV_EXECUTE")
        assert bits(gxsm) & 9 == 8 + held
        until(made, lambda: not bits(gxsm) & 8)
        assert bits(gxsm) & 1 == held
        assert made.emulator.rig.is_held(made.clock.now_s())
        until(made, lambda: not made.emulator.rig.is_held(made.clock.now_s()))
        assert bits(gxsm) & 1


def test_frequency_shift_matches_picture_and_setpoint(bench: Make) -> None:
    made = bench(speed=20.0, surface="steps", **NON_CONTACT)

    def told(code: str) -> float:
        return float(np.mean([gxsm.call("rtquery", code)[0] for _ in range(30)]))

    with calling(made) as gxsm:
        small(gxsm)
        gxsm.call("set", "RangeX", "100")
        gxsm.call("set", "dsp-fbs-scan-speed-scan", "100")  # slow enough to be seen scanning
        gxsm.call("startscan")
        until(made, lambda: bool(bits(gxsm) & 2))
        until(made, lambda: not bits(gxsm) & 2)
        labels = [one.label for one in made.emulator.program.channels]
        pictures = {label: gxsm.call("get_slice", labels.index(label), 0, 0, 3, 2) for label in set(labels)}
        assert np.median(pictures["dFreq"]) == pytest.approx(-20.0, abs=0.2)
        assert told("f") == pytest.approx(np.median(pictures["dFreq"]), abs=0.3)
        assert told("R") == pytest.approx(pictures["ZS-Topo"][:, 7:9].mean(), abs=2.0)
        assert gxsm.call("gets", "dsp-fbs-mx1-freq-set") == "-20 Hz"
        gxsm.call("set", "dsp-fbs-mx1-freq-set", "-35")
        assert told("f") == pytest.approx(-35.0, abs=0.2)
        gxsm.call("set", "dsp-fbs-mx1-freq-set", "35")
        assert told("f") == pytest.approx(0.0, abs=0.1), "never met: there is no contact"


def test_only_functions_of_the_module_can_be_called(bench: Make) -> None:
    with calling(bench(transport="shm")) as gxsm:
        for method in ("do", "bits", "pixel", "program", "answer", "_get"):
            with pytest.raises(RuntimeError, match="status -4"):
                gxsm.call(method)


@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
def test_arguments_that_c_does_not_convert_are_refused(bench: Make, kind: dict[str, Any]) -> None:
    made = bench(**kind)
    with calling(made) as gxsm:
        for method, *arguments in (
            ("get_slice", 0.0, 0, 0, 0, 1),
            ("get_geometry", "0"),
            ("chfname", 2**63),
            ("moveto_scan_xy", 2**64, 0),
            ("set", "RangeX\0", "1"),
            ("set", "RangeX", "\ud800"),
        ):
            assert not_converted(gxsm, method, *arguments)
        assert gxsm.call("get_slice", 0, 0, 0, -1, 1) == -1
        assert list(gxsm.call("get_differentials", 99)) == [0.0] * 4
        assert list(gxsm.call("get_geometry", -1)) == [0.0] * 5
        assert list(gxsm.call("get_dimensions", 7)) == [4294967295] * 4
        assert gxsm.call("moveto_scan_xy", math.nan, 0.0) == -1
        assert gxsm.call("set", "PointsX", "1e400") == 0
        assert gxsm.call("get", "PointsX") == 64.0


def test_impossible_scan_does_not_start(bench: Make) -> None:
    made = bench(speed=SEEN)
    with calling(made) as gxsm:
        small(gxsm)
        gxsm.call("set", "dsp-fbs-mx0-current-set", "-1")
        gxsm.call("startscan")
        assert not bits(gxsm) & 2
        gxsm.call("set", "dsp-fbs-mx0-current-set", "0.5")
        gxsm.call("startscan")
        until(made, lambda: bool(bits(gxsm) & 2))


def test_files_are_counted_beyond_three_digits(tmp_path: Path) -> None:
    saving = GxsmFileWriter(tmp_path, Faults([], {}, 0.0), ControllerClock())
    saving.counted([tmp_path / "scan1000-M-Xp-Topo.nc"])
    assert saving.counter == 1001


@contextmanager
def answering(folder: Path, value: object) -> Iterator[tuple[SharedMemoryBlock, MemoryClient]]:
    """Serve shared memory that answers every call with a value."""
    if not sys.platform.startswith("linux"):
        pytest.skip("Gxsm4's shared memory is there on Linux alone")
    name = f"afspm_test_{os.getpid()}_{id(value)}"
    faults = Faults([], FAULT_KINDS, 0.0)
    block = SharedMemoryBlock(name, "emulated", folder, faults, lambda: 0.0, lambda call: call.answered(value))
    client = MemoryClient(f"shm:{name}@{block.pid}")
    try:
        yield block, client
    finally:
        client.close()
        block.end()


def test_a_result_larger_than_the_memory_is_not_passed_on(tmp_path: Path) -> None:
    with answering(tmp_path, bytes(1 << 25)) as (block, gxsm):
        for _ in range(2):
            gxsm.ask("get_slice")
            block.take()
            with pytest.raises(RuntimeError, match="status -1"):
                gxsm.answer()


def test_a_call_written_over_another_does_not_block_its_answer(tmp_path: Path) -> None:
    with answering(tmp_path, bytes(1 << 23)) as (block, gxsm):
        gxsm.ask("get_slice")
        assert select.select([block], [], [], DEADLINE_S)[0]
        gxsm.ask("set", "x" * (1 << 22))
        taking = Thread(target=block.take, daemon=True)
        taking.start()
        taking.join(DEADLINE_S)
        assert not taking.is_alive()


def test_the_emulator_ends_when_its_process_is_killed(tmp_path: Path) -> None:
    with answering(tmp_path, None) as (block, _):
        os.kill(block.pid, signal.SIGKILL)
        with pytest.raises(Crashed):
            block.take()
