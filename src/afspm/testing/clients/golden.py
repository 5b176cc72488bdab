"""The reference bytes of the wire format, from an installed package or a clone."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from pathlib import Path

from afspm.basics.plain_data import Plain

FILE = "golden.json"


@cache
def golden() -> dict[str, list[Plain]]:
    """Return the contents of `proto/golden.json`, by kind."""
    package = Path(str(files("afspm")))
    installed, clone = package / "wire" / "proto" / FILE, package.parents[1] / "proto" / FILE
    text = (installed if installed.exists() else clone).read_text(encoding="utf-8")
    reference: dict[str, list[Plain]] = json.loads(text)
    return reference


def frames_of(entry: Plain) -> list[bytes]:
    """Return the frames of a reference request, response or packet."""
    return [bytes.fromhex(frame) for frame in entry["frames"]]
