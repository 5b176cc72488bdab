"""The bytes of the protocol: against reference bytes, for every release, and against any bytes at all."""

from __future__ import annotations

import json
import struct
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.emulators.nanonis import RELEASES, wire
from afspm.errors import InvalidValue
from afspm.microscopes.nanonis import protocol
from afspm.microscopes.nanonis.protocol import BadReply, NanonisError

RELEASE_NUMBERS = tuple(RELEASES.values())
NAMES = sorted(protocol.functions())


def references() -> list[Any]:
    rows = Path(__file__).with_name("reference_requests.txt").read_text().splitlines()
    return [
        pytest.param(*row.split("\t")[::3], row.split("\t")[1], id=row.split("\t")[0]) for row in rows if row[0] != "#"
    ]


@pytest.mark.parametrize(("name", "expected", "arguments"), references())
def test_requests_are_those_of_the_vendors_own_client(name: str, expected: str, arguments: str) -> None:
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


def test_both_sides_were_written_apart_and_agree_on_every_field() -> None:
    for name, function in protocol.functions().items():
        other = wire.functions()[name]
        for ours, theirs in ((function.arguments, other.arguments), (function.results, other.results)):
            assert list(ours) == [(field.code, field.since) for field in theirs], name
            assert all(field.is_in(release) or field.since for field in theirs for release in RELEASE_NUMBERS), name


EXAMPLES: dict[str, Any] = {
    "H": 7, "I": 4_000_000_000, "i": -3, "f": 0.25, "d": 1.5e-9, "S": "Größe", "A": ["Z (m)", "µ", ""],
    "[i]": [0, 14, -1], "[f]": [0.5, -2.0], "2f": np.arange(6.0).reshape(2, 3), "2S": [["a", "b"], ["c", ""]],
}  # fmt: skip


@pytest.mark.parametrize("release", RELEASE_NUMBERS)
def test_replies_of_every_release_are_read(release: int) -> None:
    for name, function in protocol.functions().items():
        sent = [EXAMPLES[code] for code, _ in function.results]
        found = protocol.results(name, wire.body(name, sent, release), release)
        expected = [EXAMPLES[code] for code in function.result_codes(release)]
        for got, wanted in zip(found, expected, strict=True):
            assert np.array_equal(got, wanted) if isinstance(wanted, np.ndarray) else got == wanted, name


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
def test_a_reply_of_another_release_is_named(name: str, written: int, read: int) -> None:
    sent = [EXAMPLES[code] for code, _ in protocol.functions()[name].results]
    with pytest.raises(BadReply, match=f"it was read as of release {read}"):
        protocol.results(name, wire.body(name, sent, written), read)


def test_a_text_that_is_not_utf8_is_read_as_windows_writes_it() -> None:
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
def test_what_can_not_be_sent_is_an_error_before_it_is(name: str, arguments: list[Any]) -> None:
    with pytest.raises(InvalidValue):
        protocol.request(name, arguments)


@pytest.mark.parametrize(
    ("header", "told"),
    [
        (b"Bias.Set".ljust(32, b"\0") + struct.pack(">i", 8) + bytes(4), "replied to 'Bias.Set'"),
        (b"Bias.Get".ljust(32, b"\0") + struct.pack(">i", -1) + bytes(4), "announced -1 bytes"),
        (b"Bias.Get".ljust(32, b"\0") + struct.pack(">i", 2**31 - 1) + bytes(4), "announced 2147483647 bytes"),
        (b"\xff" * 40, "replied to 'ÿ"),
    ],
)
def test_a_header_that_is_no_answer(header: bytes, told: str) -> None:
    with pytest.raises(BadReply, match=told):
        protocol.body_bytes(header, "Bias.Get")


# --- any bytes ---


@given(st.sampled_from(NAMES), st.binary(max_size=200), st.sampled_from(RELEASE_NUMBERS))
def test_any_body_is_results_or_an_error_with_a_name(name: str, body: bytes, release: int) -> None:
    _read(name, body, release)


@given(st.sampled_from(NAMES), st.data())
def test_a_broken_reply_is_results_or_an_error_with_a_name(name: str, data: st.DataObject) -> None:
    """What is nearly right gets further than what is not at all."""
    release = data.draw(st.sampled_from(RELEASE_NUMBERS))
    sent = [EXAMPLES[code] for code, _ in protocol.functions()[name].results]
    body = bytearray(wire.body(name, sent, release))
    for _ in range(data.draw(st.integers(1, 4))):
        where = data.draw(st.integers(0, max(0, len(body) - 4)))
        length = data.draw(st.sampled_from([0, 1, 4]))
        body[where : where + length] = data.draw(st.binary(max_size=5))
    _read(name, bytes(body), release)


def _read(name: str, body: bytes, release: int) -> None:
    # what is traced is the whole process: a thread of another test may want memory too, but not each time
    peaks = (_peak_bytes(name, body, release) for _ in range(3))
    assert any(peak < 200_000 for peak in peaks), "no more memory than what came can fill"


def _peak_bytes(name: str, body: bytes, release: int) -> int:
    """The memory that reading it takes."""
    tracemalloc.start()
    try:
        with suppress(BadReply, NanonisError):
            found = protocol.results(name, body, release)
            assert len(found) == len(protocol.functions()[name].result_codes(release))
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@given(st.binary(min_size=40, max_size=40), st.sampled_from(NAMES))
def test_any_header_is_a_size_or_an_error_with_a_name(header: bytes, name: str) -> None:
    with suppress(BadReply):
        assert 0 <= protocol.body_bytes(header, name) <= protocol.LARGEST_BODY


@given(st.binary(max_size=300))
def test_any_bytes_are_requests_to_the_emulated_controller_or_are_none(received: bytes) -> None:
    left = bytearray(received)
    with suppress(wire.Unreadable):
        while (request := wire.split(left)) is not None:
            name, _, body = request
            if name in wire.functions():
                wire.arguments(name, body, max(RELEASE_NUMBERS))


@given(st.sampled_from(sorted(wire.functions())), st.binary(max_size=100))
def test_any_arguments_are_read_by_the_emulated_controller_or_unreadable(name: str, body: bytes) -> None:
    with suppress(wire.Unreadable):
        found = wire.arguments(name, body, max(RELEASE_NUMBERS))
        assert len(found) == len(wire.functions()[name].argument_codes(max(RELEASE_NUMBERS)))
