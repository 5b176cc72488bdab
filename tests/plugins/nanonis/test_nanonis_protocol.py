"""The bytes of the protocol: reference bytes, every release, and arbitrary bytes."""

from __future__ import annotations

import json
import socket
import struct
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deadlines import DEADLINE_S
from hypothesis import given
from hypothesis import strategies as st

from afspm import read
from afspm.basics import ExperimentClock, InvalidValue
from afspm.plugins.nanonis import protocol
from afspm.plugins.nanonis.emulator import RELEASES, NanonisEmulator, wire
from afspm.plugins.nanonis.protocol import BadReply, NanonisError

RELEASE_NUMBERS = tuple(RELEASES.values())
NAMES = sorted(protocol.function_names())


def references() -> list[Any]:
    rows = Path(__file__).with_name("reference_requests.txt").read_text().splitlines()
    return [
        pytest.param(*row.split("\t")[::3], row.split("\t")[1], id=row.split("\t")[0]) for row in rows if row[0] != "#"
    ]


@pytest.mark.parametrize(("name", "expected", "arguments"), references())
def test_requests_equal_those_from_the_vendors_client(name: str, expected: str, arguments: str) -> None:
    assert protocol.request(name, json.loads(arguments)).hex() == expected


@pytest.mark.parametrize(("name", "expected", "arguments"), references())
def test_the_emulated_controller_reads_the_reference_requests(name: str, expected: str, arguments: str) -> None:
    received = bytearray.fromhex(expected)
    request = wire.split(received)
    assert request is not None
    assert request[:2] == (name, True)
    assert not received
    read = wire.arguments(name, request[2], max(RELEASE_NUMBERS))
    for got, sent in zip(read, json.loads(arguments), strict=True):
        assert got == (pytest.approx(sent, rel=1e-6) if isinstance(sent, float) else sent)


def test_both_sides_read_the_same_fields_of_every_function_and_release() -> None:
    assert protocol.function_names() == wire.functions().keys()
    for name, other in wire.functions().items():
        function = protocol.function(name)
        for release in RELEASE_NUMBERS:
            sent = [one.code for one in function.arguments if one.since <= release < one.until]
            assert sent == other.argument_codes(release), name
            assert list(function.result_codes(release)[0]) == other.result_codes(release), name


EXAMPLES: dict[str, Any] = {
    "H": 7, "I": 4_000_000_000, "i": -3, "f": 0.25, "d": 1.5e-9, "S": "Größe", "A": ["Z (m)", "µ", ""],
    "[i]": [0, 14, -1], "[f]": [0.5, -2.0], "2f": np.arange(6.0).reshape(2, 3), "2S": [["a", "b"], ["c", ""]],
    "[B]": [0, 255], "[I]": [4_000_000_000], "[d]": [1.5e-9, 0.0], "n": 2, "*i": [-1, 2], "*I": [1, 4_000_000_000],
    "*f": [0.5, -2.0], "*S": ["Größe", ""],
}  # fmt: skip


def examples(fields: protocol.Fields) -> list[Any]:
    return [EXAMPLES[field.code] for field in fields]


@pytest.mark.parametrize("release", RELEASE_NUMBERS)
def test_requests_of_every_release_are_read(release: int) -> None:
    for name in NAMES:
        fields = protocol.function(name).arguments
        received = bytearray(protocol.request(name, examples(fields), release))
        request = wire.split(received)
        assert request is not None
        expected = [EXAMPLES[one.code] for one in fields if one.since <= release < one.until]
        for got, wanted in zip(wire.arguments(name, request[2], release), expected, strict=True):
            assert np.array_equal(np.asarray(got), wanted) if isinstance(wanted, np.ndarray) else got == wanted, name


@pytest.mark.parametrize("release", RELEASE_NUMBERS)
def test_replies_of_every_release_are_read(release: int) -> None:
    for name in NAMES:
        sent = examples(protocol.function(name).layouts[0])
        found = protocol.results(name, wire.body(name, sent, release), release)
        expected = [EXAMPLES[code] for code in protocol.function(name).result_codes(release)[0]]
        for got, wanted in zip(found, expected, strict=True):
            assert np.array_equal(np.asarray(got), wanted) if isinstance(wanted, np.ndarray) else got == wanted, name


@pytest.mark.parametrize("bare", [False, True])
@pytest.mark.parametrize("text", ["no", "", "Gerät im Schlaf"])
def test_errors_are_read_with_results_and_without(text: str, bare: bool) -> None:
    for name in NAMES:
        body = wire.error_body(name, text, max(RELEASE_NUMBERS), bare=bare)
        with pytest.raises(NanonisError) as caught:
            protocol.results(name, body)
        assert (text or "no reason given") in str(caught.value)
        assert name in str(caught.value)


@pytest.mark.parametrize(
    ("name", "written", "read"),
    [("Scan.PropsGet", 14573, 14429), ("Scan.PropsGet", 13742, 14573), ("Piezo.DriftCompGet", 10862, 11798)],
)
def test_reply_of_another_release_is_reported(name: str, written: int, read: int) -> None:
    sent = examples(protocol.function(name).layouts[0])
    with pytest.raises(BadReply, match=f"it was read as release {read}"):
        protocol.results(name, wire.body(name, sent, written), read)


@pytest.mark.parametrize("index", [b"\0\0\0\2", b"\0\2"], ids=["int32", "uint16"])
@pytest.mark.parametrize("filters", [b"", bytes(12)], ids=["without-filters", "with-filters"])
def test_gains_are_read_in_each_layout(index: bytes, filters: bytes) -> None:
    # the maker's text and its client differ in the index
    labels = [b"LN 10^7", b"LN 10^8", b"LN 10^9"]
    texts = b"".join(len(label).to_bytes(4) + label for label in labels)
    body = len(texts).to_bytes(4) + len(labels).to_bytes(4) + texts + index + filters + bytes(8)
    assert protocol.results("Current.GainsGet", body)[:2] == (["LN 10^7", "LN 10^8", "LN 10^9"], 2)


def test_text_in_windows_encoding_is_read() -> None:
    body = wire.body("Util.SessionPathGet", ["C:\\Müller"], 0, "latin-1")
    assert protocol.results("Util.SessionPathGet", body) == ("C:\\Müller",)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("Bias.Set", ["text"]),
        ("Bias.Set", [1e300]),
        ("Bias.Set", []),
        ("Scan.Action", [-1, 0]),
        ("Scan.BufferSet", [[0.5], 16, 16]),
        ("Bias.Wrong", []),
    ],
)
def test_unsendable_arguments_are_refused(name: str, arguments: list[Any]) -> None:
    with pytest.raises(InvalidValue):
        protocol.request(name, arguments)


@pytest.mark.parametrize(
    ("header", "problem"),
    [
        (b"Bias.Set".ljust(32, b"\0") + struct.pack(">i", 8) + bytes(4), "replied to 'Bias.Set'"),
        (b"Bias.Get".ljust(32, b"\0") + struct.pack(">i", -1) + bytes(4), "announced -1 bytes"),
        (b"Bias.Get".ljust(32, b"\0") + struct.pack(">i", 2**31 - 1) + bytes(4), "announced 2147483647 bytes"),
        (b"\xff" * 40, "replied to 'ÿ"),
    ],
)
def test_malformed_header_is_refused(header: bytes, problem: str) -> None:
    with pytest.raises(BadReply, match=problem):
        protocol.body_bytes(header, "Bias.Get")


# --- any bytes ---


@given(st.sampled_from(NAMES), st.binary(max_size=200), st.sampled_from(RELEASE_NUMBERS))
def test_any_body_is_results_or_a_named_error(name: str, body: bytes, release: int) -> None:
    _read(name, body, release)


@given(st.sampled_from(NAMES), st.data())
def test_damaged_reply_is_results_or_a_named_error(name: str, data: st.DataObject) -> None:
    # Nearly right replies get further than random bytes.
    release = data.draw(st.sampled_from(RELEASE_NUMBERS))
    sent = examples(protocol.function(name).layouts[0])
    body = bytearray(wire.body(name, sent, release))
    for _ in range(data.draw(st.integers(1, 4))):
        where = data.draw(st.integers(0, max(0, len(body) - 4)))
        length = data.draw(st.sampled_from([0, 1, 4]))
        body[where : where + length] = data.draw(st.binary(max_size=5))
    _read(name, bytes(body), release)


def _read(name: str, body: bytes, release: int) -> None:
    # tracing covers the whole process: a thread of another test may need memory too, but not each time
    peaks = (_peak_bytes(name, body, release) for _ in range(3))
    assert any(peak < 200_000 for peak in peaks), "no more memory than what came can fill"


def _peak_bytes(name: str, body: bytes, release: int) -> int:
    tracemalloc.start()
    try:
        with suppress(BadReply, NanonisError):
            found = protocol.results(name, body, release)
            assert len(found) in map(len, protocol.function(name).result_codes(release))
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@given(st.binary(min_size=40, max_size=40), st.sampled_from(NAMES))
def test_any_header_is_a_size_or_a_named_error(header: bytes, name: str) -> None:
    with suppress(BadReply):
        assert 0 <= protocol.body_bytes(header, name) <= protocol.LARGEST_BODY


@given(st.binary(max_size=300))
def test_any_bytes_are_requests_or_malformed(received: bytes) -> None:
    left = bytearray(received)
    with suppress(wire.MalformedRequest):
        while (request := wire.split(left)) is not None:
            name, _, body = request
            if name in wire.functions():
                wire.arguments(name, body, max(RELEASE_NUMBERS))


@given(st.sampled_from(sorted(wire.functions())), st.binary(max_size=100))
def test_any_arguments_are_read_or_malformed(name: str, body: bytes) -> None:
    with suppress(wire.MalformedRequest):
        found = wire.arguments(name, body, max(RELEASE_NUMBERS))
        assert len(found) == len(wire.functions()[name].argument_codes(max(RELEASE_NUMBERS)))


# --- releases ---


@pytest.mark.parametrize(
    ("name", "release", "codes"),
    [
        ("BiasSpectr.PropsGet", 10862, "H i H i A A A"),
        ("BiasSpectr.PropsGet", 11798, "H i H i A A H H"),
        ("ZSpectr.PropsGet", 10862, "H i A A A H H"),
        ("ZSpectr.PropsGet", 11798, "H i A A H H H H"),
        ("BiasSpectr.ChsGet", 10862, "[i]"),
        ("BiasSpectr.ChsGet", 13742, "[i]"),
        ("ZSpectr.ChsGet", 14429, "[i] A"),
    ],
)
def test_reply_has_the_fields_of_the_release(name: str, release: int, codes: str) -> None:
    assert wire.functions()[name].result_codes(release) == codes.split()


@pytest.mark.parametrize("release", RELEASE_NUMBERS)
def test_spectrum_properties_have_the_order_of_each_release(tmp_path: Path, release: int) -> None:
    asked = ["BiasSpectr.Open", "ZSpectr.Open", "BiasSpectr.PropsGet", "ZSpectr.PropsGet"]
    with NanonisEmulator(port=0, release=release).running(tmp_path) as address:
        *_, bias, z = (_asked(address, name) for name in asked)
    autosave, dialog, sweeps, save_all = b"\0\1", b"\0\0", b"\0\1", b"\0\0"
    no_error = bytes(8)
    assert bias.endswith((autosave + dialog if release >= 11798 else b"Y (m)") + no_error)
    assert z.endswith(sweeps + (autosave + dialog if release >= 11798 else b"") + save_all + no_error)
    assert (b"Current (A)" in bias) == (release < 11798)


def test_function_names_ignore_case_and_are_echoed(tmp_path: Path) -> None:
    with NanonisEmulator(port=0).running(tmp_path) as address:
        assert _asked(address, "util.versionget").endswith(bytes(8))
        assert b"Error in command: bias.nonsense: " in _asked(address, "Bias.Nonsense")
        assert b"Error in command: laser.powerget: Module not available" in _asked(address, "Laser.PowerGet")


def test_wait_end_of_line_returns_at_each_line(tmp_path: Path) -> None:
    with NanonisEmulator(port=0).running(tmp_path, ExperimentClock.starting_now(speed=20.0)) as address:
        buffer = struct.pack(">iiii", 1, 14, 16, 16)
        assert _asked(address, "Scan.BufferSet", buffer).endswith(bytes(8))
        timed_out = _asked(address, "Scan.WaitEndOfLine", struct.pack(">i", 50))
        assert (len(timed_out), struct.unpack(">IiHi", timed_out[:-8])[0]) == (22, 1)
        _asked(address, "Scan.Action", struct.pack(">HI", 0, 1))
        replies = [struct.unpack(">IiHi", _asked(address, "Scan.WaitEndOfLine", b"\xff" * 4)[:-8]) for _ in range(6)]
    assert all(timed_out == 0 and 1 <= line <= 16 for timed_out, line, _, _ in replies)
    passes = [2 * line + backward for _, line, backward, _ in replies]
    assert passes == sorted(set(passes))


def test_functions_that_the_makers_client_lacks_are_as_documented(tmp_path: Path) -> None:
    # After the document of April 2025 (release 14718).
    nan = float("nan")
    with NanonisEmulator(port=0).running(tmp_path) as address:
        for name, set_, got in (
            ("BiasSpectr.SafeCond1", struct.pack(">HfiH", 3, 2e-9, 0, 1), struct.pack(">HfiH", 2, 2e-9, 0, 1)),
            ("BiasSpectr.SafeCond1", struct.pack(">HfiH", 0, nan, -1, 2), struct.pack(">HfiH", 2, 2e-9, 0, 1)),
            ("BiasSpectr.SafeCond2", struct.pack(">ifiH", 3, 1e-9, 18, 0), struct.pack(">ifiH", 3, 1e-9, 18, 0)),
            ("BiasSpectr.SafeCond2", struct.pack(">ifiH", -1, nan, -1, 2), struct.pack(">ifiH", 3, 1e-9, 18, 0)),
        ):
            assert _asked(address, f"{name}Set", set_) == bytes(8)
            assert _asked(address, f"{name}Get") == got + bytes(8)
        _asked(address, "PLL.PhasCtrlGainSet", struct.pack(">iff", 1, 3.0, 0.5))
        assert _asked(address, "PLL.PhasCtrlGainGet", struct.pack(">i", 1)) == struct.pack(
            ">3f", 3.0, 0.5, 6.0
        ) + bytes(8)
        for name, sent in (
            ("PLLQCtrl.AccessRequest", ">I"), ("PLLQCtrl.AccessGet", ""), ("PLLQCtrl.OnOffSet", ">I"),
            ("PLLQCtrl.OnOffGet", ""), ("PLLQCtrl.QGainSet", ">f"), ("PLLQCtrl.QGainGet", ""),
            ("PLLQCtrl.PhaseSet", ">if"), ("PLLQCtrl.PhaseGet", ""), ("DigLines.TTLValGet", ">I"),
            ("DigLines.Pulse", ">IiBffiI"),
        ):  # fmt: skip
            arguments = (
                struct.pack(">IiBffiI", 4, 1, 1, 0.1, 0.1, 1, 0) if "B" in sent else bytes(struct.calcsize(sent))
            )
            assert b"Module not available" in _asked(address, name, arguments), "modules that this instrument lacks"
        assert b"not part of this emulator" in _asked(address, "PLL.PerfectPLLApply", struct.pack(">i", 1))


def test_saved_spectrum_can_be_loaded(tmp_path: Path) -> None:
    session = tmp_path / "session"
    secret = tmp_path / "secret.dat"
    secret.write_text("[DATA]\nx\n1\n")
    with NanonisEmulator(port=0).running(session, ExperimentClock.starting_now(speed=20.0)) as address:

        def loaded(path: Path, header_only: int) -> bytes:
            text = str(path).encode()
            return _asked(address, "File.datLoad", struct.pack(">i", len(text)) + text + struct.pack(">I", header_only))

        _asked(address, "BiasSpectr.Open")
        measured = _asked(address, "BiasSpectr.Start", struct.pack(">Ii", 1, 5) + b"curve")
        whole, header = (loaded(session / "curve00001.dat", only) for only in (0, 1))
        assert b"can't be loaded" in loaded(secret, 0)
        assert b"can't be loaded" in loaded(session / "nothing.dat", 0)
    assert _texts(whole) == _texts(measured)
    at = 4 + struct.unpack_from(">i", whole)[0] + 4
    rows, columns = struct.unpack_from(">ii", whole, at)
    assert (rows, columns) == struct.unpack_from(">ii", measured, at)
    there, back = (np.frombuffer(reply, ">f4", rows * columns, at + 8) for reply in (measured, whole))
    np.testing.assert_allclose(back, there, rtol=1e-4, atol=1e-18)
    lines, width = struct.unpack_from(">ii", whole, at + 8 + 4 * rows * columns)
    assert (lines > 5, width) == (True, 2)
    assert header == bytes(16) + whole[at + 8 + 4 * rows * columns :]
    assert b"Experiment" in header
    assert b"bias spectroscopy" in header


def test_session_path_changes_within_its_folder(tmp_path: Path) -> None:
    session = tmp_path / "session"
    with NanonisEmulator(port=0).running(session) as address:
        for path, said in (
            (session / "night", bytes(8)),
            (tmp_path, b"not valid"),
            (session / ".." / "x", b"can't be"),
        ):
            text = str(path).encode()
            assert said in _asked(address, "Util.SessionPathSet", struct.pack(">i", len(text)) + text + bytes(4))
        assert str(session / "night").encode() in _asked(address, "Util.SessionPathGet")
    assert (session / "night").is_dir()
    assert [path.name for path in tmp_path.iterdir()] == ["session"]


def test_frequency_shift_matches_setpoint_and_picture(tmp_path: Path) -> None:
    # All clients read the same sensor: signals, PLL, the picture and the file's header.
    emulator = NanonisEmulator(feedback={"mode": "frequency-shift", "setpoint": -20.0})
    with emulator.running(tmp_path, ExperimentClock.starting_now(speed=2.0)) as address:  # its end is awaited

        def told_hz(name: str, body: bytes) -> float:
            return float(np.mean([struct.unpack_from(">f", _asked(address, name, body))[0] for _ in range(40)]))

        names = _asked(address, "Signals.NamesGet")
        index = next(k for k, name in enumerate(_texts(names)) if name == "OC M1 Freq. Shift (Hz)")
        assert b"OC M1 Freq. Shift" in _asked(address, "ZCtrl.CtrlListGet")
        for setpoint_hz in (-20.0, -5.0):
            _asked(address, "ZCtrl.SetpntSet", struct.pack(">f", setpoint_hz))
            assert told_hz("Signals.ValGet", struct.pack(">iI", index, 1)) == pytest.approx(setpoint_hz, abs=0.1)
            assert told_hz("PLL.FreqShiftGet", struct.pack(">i", 1)) == pytest.approx(setpoint_hz, abs=0.1)
        _asked(address, "Scan.BufferSet", struct.pack(">iiii", 1, index, 16, 16))
        _asked(address, "Scan.FrameSet", struct.pack(">5f", 0.0, 0.0, 1e-8, 1e-8, 0.0))
        _asked(address, "Scan.Action", struct.pack(">HI", 0, 1))
        ended = _asked(address, "Scan.WaitEndOfScan", struct.pack(">i", -1))
        (scan,) = read(Path(ended[8:-8].decode())).scans[:1]
        assert scan.channel == "OC_M1_Freq._Shift Forward"
        assert np.median(scan.values) == pytest.approx(-5.0, abs=0.2)
        assert "OC M1 Freq. Shift\t1\t-5.000E+0 Hz" in Path(ended[8:-8].decode()).read_bytes()[:5000].decode("latin-1")
        _asked(address, "ZCtrl.Withdraw", struct.pack(">Ii", 1, -1))
        assert told_hz("PLL.FreqShiftGet", struct.pack(">i", 1)) == pytest.approx(0.0, abs=0.1)


def _texts(reply: bytes) -> list[str]:
    found, at = [], 8
    for _ in range(struct.unpack_from(">i", reply, 4)[0]):
        length = struct.unpack_from(">i", reply, at)[0]
        found.append(reply[at + 4 : at + 4 + length].decode())
        at += 4 + length
    return found


def _asked(address: str, name: str, body: bytes = b"") -> bytes:
    host, port = address.split(":")
    with socket.create_connection((host, int(port)), timeout=DEADLINE_S) as connection:
        connection.sendall(name.encode().ljust(32, b"\0") + struct.pack(">iHH", len(body), 1, 0) + body)
        reader = connection.makefile("rb")
        header = reader.read(40)
        assert header[:32].rstrip(b"\0").decode() == name
        return reader.read(struct.unpack_from(">i", header, 32)[0])
