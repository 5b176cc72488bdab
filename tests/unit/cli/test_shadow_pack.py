"""Private texts of a shadow's run: found, and replaced by texts of the same length."""

from __future__ import annotations

import io
import json
import struct

import h5py
import numpy as np
import pytest

from afspm.cli.shadow_pack import Mask, PrivateText, _folders

FOLDER = r"C:\Users\Ada Lovelace\Nanonis Session"
PRIVATE = [
    PrivateText("", FOLDER),
    PrivateText("", "Ada"),
    PrivateText("", 'a "b"\nc'),
    PrivateText("", "graphene", True),
]


def prefixed(text: str) -> bytes:
    return struct.pack(">i", len(text)) + text.encode()


@pytest.mark.parametrize(
    "content",
    [
        f"path = {FOLDER}".encode(),
        json.dumps({"path": FOLDER, "note": 'a "b"\nc'}).encode(),
        b"\0\0\0\0" + prefixed(FOLDER) + prefixed("Ada") + bytes(4),
        b":COMMENT:\nby Ada\n\n:END:\n\x1a\x04" + bytes(100),
        "graphene0012.sxm".encode("utf-16-le"),
    ],
    ids=["text", "json", "lengths before texts", "header of a binary file", "wide"],
)
def test_private_texts_are_replaced_and_lengths_stay(content: bytes) -> None:
    masked = Mask(PRIVATE).of(content)
    assert len(masked) == len(content)
    assert not [word for word in (b"Ada", b"Lovelace", b"Session", b"graphene") if word in masked.replace(b"\0", b"")]
    if content.startswith(b"{"):
        assert json.loads(masked).keys() == {"path", "note"}


def test_values_of_a_message_stay_and_are_no_folders() -> None:
    values = np.random.default_rng(1).normal(size=200_000).astype(">f4").tobytes()
    content = bytes(4) + values
    assert Mask(PRIVATE).of(content) == content
    assert _folders(content) == ()


def test_folder_is_found_in_text_and_behind_its_length() -> None:
    assert _folders(bytes(8) + prefixed(FOLDER) + bytes(4))[0] == FOLDER
    assert _folders(json.dumps({"path": FOLDER + "\\x.sxm"}).encode()) == (FOLDER,)
    assert _folders(b"QUJD/NwQAAAA/ODcY29AAAA/QLercEA") == ()


def test_texts_in_hdf5_are_replaced_by_its_library() -> None:
    made = io.BytesIO()
    with h5py.File(made, "w") as file:
        file.attrs["comment"] = "by Ada"
        file["letters"] = np.frombuffer(b"Ada was here", "S1")
        file["z"] = np.arange(6.0)
    with h5py.File(io.BytesIO(Mask(PRIVATE).file(made.getvalue())), "r") as masked:
        assert masked.attrs["comment"] == "by xxx"
        assert masked["letters"][()].tobytes() == b"xxx was here"
        assert list(masked["z"][()]) == list(range(6))
