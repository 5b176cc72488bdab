"""Asylum without sockets: requests and replies, frames, folders."""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from afspm import read
from afspm.basics import AfspmError, ConfigError, InvalidValue
from afspm.model import Region, ScopeState, names
from afspm.plugins.asylum import Asylum, xop
from afspm.plugins.asylum.emulator import wire
from afspm.plugins.asylum.emulator.files import igor_wave
from afspm.plugins.asylum.result_files import local
from afspm.plugins.asylum.scan_files import center_and_angle
from afspm.plugins.asylum.session import Doing
from afspm.plugins.asylum.settings import NAMES, asylums, from_image, generic, on_image

finite = st.floats(-1e300, 1e300)


# --- requests and replies ---


@given(st.lists(st.one_of(st.booleans(), finite, st.integers(-1000, 1000), st.text(max_size=20)), max_size=5))
def test_request_arrives_unchanged_at_the_xop(parameters: list[Any]) -> None:
    try:
        message = xop.request("F", parameters, "7")
    except InvalidValue:
        assert any(isinstance(one, str) and not _sendable(one) for one in parameters)
        return
    received = wire.call(message)
    assert (received.name, received.message_id) == ("F", "7")
    for sent, text in zip(parameters, received.parameters, strict=True):
        if isinstance(sent, str):
            assert text == sent
        else:
            assert float(text) == pytest.approx(float(sent), rel=1e-14, abs=1e-320)


def _sendable(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


@pytest.mark.parametrize("parameter", [math.nan, math.inf, "\ud800", "x" * 1024])
def test_unsendable_request_is_refused(parameter: float | str) -> None:
    with pytest.raises(InvalidValue, match="F"):
        xop.request("F", [parameter], "7")


def test_longest_request_has_1024_bytes() -> None:
    spare = 1024 - len(xop.request("F", [""], "7"))
    assert len(xop.request("F", ["x" * spare], "7")) == 1024
    with pytest.raises(InvalidValue, match="the call of F has 1025 bytes"):
        xop.request("F", ["x" * (spare + 1)], "7")


@pytest.mark.parametrize("value", [3.0, 1e-9, 0.1, -1.5e300, math.inf, -math.inf, math.nan])
def test_numbers_survive_a_round_trip(value: float) -> None:
    reply = xop.reply(wire.success(wire.IgorFunction(lambda: value), value, "7"))
    assert reply.message_id == "7"
    np.testing.assert_equal(reply.results, (value,))


def test_reply_with_several_results_skips_waves() -> None:
    several = wire.IgorFunction(lambda: None, "", "vsd")
    assert xop.reply(wire.success(several, (1.0, "", "root:"), "7")).results == (1.0, "", "root:")
    wave = wire.wave([1.0, 2.0], note="height")
    assert xop.reply(wire.success(wire.IgorFunction(lambda: None, "", "w"), wave, "7")).results == (None,)


def test_error_has_number_meaning_and_history() -> None:
    reply = xop.reply(wire.failure(wire.CallFailed(107, "index out of range"), "7"))
    assert reply.error is not None
    error = xop.XopError(*reply.error, where="F")
    assert error.number == 107
    meant = "CallFunction: The function was partially executed but aborted at some point."
    assert f"the function was aborted (107: {meant} index out of range)" in str(error)


GOOD = wire.success(wire.IgorFunction(lambda: None, "S", "v"), (1.0, ("a",)), "7")


@settings(max_examples=300)
@given(st.binary(max_size=200))
def test_malformed_reply_raises_bad_reply(message: bytes) -> None:
    with pytest.raises(xop.BadReply):
        xop.reply(message)


@settings(max_examples=300)
@given(st.integers(0, len(GOOD) - 1), st.integers(0, 255))
def test_reply_with_a_wrong_byte_parses_or_raises_bad_reply(at: int, byte: int) -> None:
    message = bytearray(GOOD)
    message[at] = byte
    for damaged in (bytes(message), GOOD[:at]):
        with contextlib.suppress(xop.BadReply):
            assert isinstance(xop.reply(damaged), xop.Reply)


_json = st.recursive(
    st.one_of(st.none(), st.booleans(), finite, st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=8,
)


@settings(max_examples=300)
@given(
    st.fixed_dictionaries({"errorCode": st.one_of(_json, st.just({"value": 0})), "result": _json, "messageID": _json})
)
def test_json_of_another_shape_parses_or_raises_bad_reply(content: dict[str, Any]) -> None:
    try:
        reply = xop.reply(json.dumps(content).encode())
    except xop.BadReply:
        return
    assert all(isinstance(one, float | str | None) for one in reply.results)


@pytest.mark.parametrize(
    "value",
    [
        {"type": "variable", "value": "1"},
        {"type": "variable", "value": True},
        {"type": "string", "value": 1},
        {"type": "struct", "value": 1},
    ],
)
def test_result_of_another_type_raises_bad_reply(value: dict[str, Any]) -> None:
    with pytest.raises(xop.BadReply):
        xop.reply(json.dumps({"errorCode": {"value": 0}, "result": value}).encode())


def test_endless_json_raises_bad_reply() -> None:
    with pytest.raises(xop.BadReply):
        xop.reply(b"[" * 100_000)


# --- frames ---

lengths = st.floats(1e-9, 1e-4)
places = st.floats(-1e-4, 1e-4)


@given(places, places, lengths, lengths, st.floats(-math.pi, math.pi), st.floats(1e-9, 1e-3))
def test_settings_define_the_frame_that_asylum_scans(
    x: float, y: float, fast: float, slow: float, angle: float, speed: float
) -> None:
    region = Region((x, y), (fast, slow), angle)
    wanted = {
        names.SCAN_TOP_LEFT_X: region.top_left_m[0],
        names.SCAN_TOP_LEFT_Y: region.top_left_m[1],
        names.SCAN_SIZE_X: fast,
        names.SCAN_SIZE_Y: slow,
        names.SCAN_ANGLE: angle,
        names.SCAN_RESOLUTION_X: 64,
        names.SCAN_RESOLUTION_Y: 32,
        names.SCAN_SPEED: speed,
    }
    assert wanted.keys() == NAMES
    there = asylums(wanted, wanted)
    assert there["XOffset"] == pytest.approx(x, abs=1e-18)
    ratio = there["SlowRatio"] / there["FastRatio"]  # as Asylum's software takes it
    longer = there["ScanSize"]
    sizes = (longer / ratio, longer) if ratio > 1 else (longer, longer * ratio)
    assert sizes == pytest.approx((fast, slow))
    assert there["ScanRate"] * 2.5 * fast == pytest.approx(speed)
    back = generic(there)
    assert {name: back[name] for name in wanted} == pytest.approx(wanted, rel=1e-12, abs=1e-16)


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_frame_at_speed_zero_is_refused(value: float) -> None:
    there = {"XOffset": 0.0, "YOffset": 0.0, "FastScanSize": 1e-6, "SlowScanSize": 1e-6, "ScanAngle": 0.0}
    before = generic(there | {"ScanPoints": 8, "ScanLines": 8, "ScanRate": 1.0})
    with pytest.raises(InvalidValue):
        asylums({names.SCAN_SPEED: value}, before)


def test_asylum_angles_are_clockwise() -> None:
    # Asylum's software calculates the start of a scan with the fast axis along (cos, -sin) of ScanAngle.
    there = {"XOffset": 0.0, "YOffset": 0.0, "FastScanSize": 2e-6, "SlowScanSize": 1e-6, "ScanAngle": 90.0}
    told = generic(there | {"ScanPoints": 8, "ScanLines": 8, "ScanRate": 1.0})
    corner = (float(told[names.SCAN_TOP_LEFT_X]), float(told[names.SCAN_TOP_LEFT_Y]))
    region = Region.from_top_left(corner, (2e-6, 1e-6), float(told[names.SCAN_ANGLE]))
    first, along = region.corners_m()[:2]
    assert along - first == pytest.approx((0.0, -2e-6), abs=1e-18)
    assert math.degrees(center_and_angle({"XOffset": "0", "YOffset": "0", "ScanAngle": "30"})[1]) == pytest.approx(-30)


@given(places, places, st.floats(-math.pi, math.pi))
def test_spots_count_from_the_lower_left_corner_along_the_axes(x: float, y: float, angle: float) -> None:
    image = Region((3e-6, -2e-6), (4e-6, 1e-6), angle)
    assert on_image(image.center_m, image) == pytest.approx((2e-6, 0.5e-6), abs=1e-18)
    assert on_image(tuple(image.corners_m()[0]), image) == pytest.approx((0.0, 0.0), abs=1e-18)
    assert on_image(tuple(image.corners_m()[1]), image) == pytest.approx((4e-6, 0.0), abs=1e-18)
    assert from_image(on_image((x, y), image), image) == pytest.approx((x, y), abs=1e-18)


# --- what it does ---


@pytest.mark.parametrize(
    ("bits", "scanning", "mapping", "state"),
    [
        (0x0, False, False, ScopeState.FREE),
        (0x2, False, False, ScopeState.FREE),
        (0x3, False, False, ScopeState.SCANNING),
        (0x0, True, False, ScopeState.SCANNING),
        (None, True, False, ScopeState.SCANNING),
        (0x12, False, False, ScopeState.SPEC),
        (0x40, False, False, ScopeState.SPEC),
        (0x0, False, True, ScopeState.SPEC),
        (0x100000, False, False, ScopeState.COARSE_MOTOR),
        (None, False, False, ScopeState.FREE),
    ],
)
def test_state_counts_both_sources(bits: int | None, scanning: bool, mapping: bool, state: ScopeState) -> None:
    assert Doing(bits, scanning, mapping).state is state


# --- folders and settings ---


def test_folder_follows_the_longest_matching_prefix() -> None:
    folders = {"C:Users:": "/mnt/users", "c:users:Asylum User:Data": "/mnt/data"}
    assert local("C:Users:Asylum User:Data:240820:", folders) == Path("/mnt/data/240820")
    assert local("C:Users:Asylum User:Database:", folders) == Path("/mnt/users/Asylum User/Database")
    assert local(":home:me:", folders) == Path("/home/me")


def test_unreachable_folder_is_a_config_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(ConfigError, match="which is not on this computer"):
        local("C:Users:Me:", {"D:": "/mnt"})
    monkeypatch.setattr("sys.platform", "win32")
    assert str(local("C:Users:Me:", {})).replace("/", "\\").endswith("C:\\Users\\Me")
    with pytest.raises(AfspmError):
        local("Server:Me:", {})


@pytest.mark.parametrize(
    "setting",
    [
        {"base_name": "1st"},
        {"base_name": "MyMask"},
        {"base_name": "x" * 18},
        {"base_name": "a night"},
        {"base_name": "a/../b"},
        {"base_name": "a:b"},
        {"spots": "?"},
    ],
)
def test_invalid_settings_are_refused(setting: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        Asylum(**setting)


def test_without_spots_the_tip_can_not_be_moved() -> None:
    assert not {names.PROBE_POS_X, names.PROBE_POS_Y} & Asylum(spots="none").table.keys()


# --- files ---


def test_each_column_of_a_curve_has_its_own_unit(tmp_path: Path) -> None:
    columns = ["Raw", "Defl", "Amp", "Phase", "Freq", "Bias", "Cur", "ZSnsr", "Odd"]
    values = np.ones((16, len(columns)))
    path = tmp_path / "Curve0000.ibw"
    path.write_bytes(igor_wave("Curve0000", values, "m", [(1e-3, "s")], columns, b"ScanRate: 1\r", 0.0))
    (curve,) = read(path).spectra
    assert curve.names == (*columns, "Time")
    assert curve.units == ("m", "m", "m", "deg", "Hz", "V", "A", "m", "", "s")
