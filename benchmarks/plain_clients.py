"""The makers' own Python clients at an emulated controller: the work of a careful script for each request of afspm.

A script reads back what it sets, as a translator does. Nanosurf's client writes into its own folder, and for Gxsm and
Asylum there is none: their translators are measured without a comparison.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from typing import Any

import numpy as np

from afspm.model import Region, ScanParameters

ASKED, SET, FRAME = "a value asked for", "a value set", "a frame set"
Work = Mapping[str, Callable[[int], object]]
"""The work of a request of each kind; the number makes each setting differ from the one before."""


def _frame(frame: ScanParameters) -> tuple[tuple[float, float], tuple[float, float], tuple[int, int]]:
    region, shape = frame.region, frame.shape
    assert isinstance(region, Region)
    assert isinstance(shape, tuple)
    return region.center_m, region.size_m, shape


@contextmanager
def nanonis(address: str, frames: tuple[ScanParameters, ScanParameters]) -> Iterator[Work]:
    from nanonis_spm import Nanonis

    host, _, ports = address.partition(":")
    with socket.create_connection((host, int(ports.split(",")[0])), timeout=60.0) as connection:
        client: Any = Nanonis(connection)

        def ask(function: str, *arguments: Any) -> Any:
            error, _, values = getattr(client, function)(*arguments)
            assert not error, f"{function}: {error}"
            return values

        channels = [int(np.ravel(channel)[0]) for channel in ask("Scan_BufferGet")[1]]

        def set_bias(number: int) -> None:
            ask("Bias_Set", (0.1, 0.2)[number % 2])
            ask("Bias_Get")

        def set_frame(number: int) -> None:
            (x_m, y_m), (width_m, height_m), (rows, columns) = _frame(frames[number % 2])
            ask("Scan_FrameSet", x_m, y_m, width_m, height_m, 0.0)
            ask("Scan_BufferSet", channels, columns, rows)
            ask("Scan_FrameGet")
            ask("Scan_BufferGet")

        yield {ASKED: lambda _: ask("Scan_SpeedGet"), SET: set_bias, FRAME: set_frame}


@contextmanager
def park(address: str, frames: tuple[ScanParameters, ScanParameters]) -> Iterator[Work]:
    from SmartRemote import SmartRemote

    SmartRemote.address = address
    client: Any = SmartRemote()

    def do(script: str) -> Any:
        reply = client.send_script(script)
        assert "value" in reply, reply
        return reply["value"]

    def set_bias(number: int) -> None:
        do(f"spm.bias.tip = {(0.1, 0.2)[number % 2]}")
        do("spm.bias.tip;")

    def set_frame(number: int) -> None:
        (x_m, y_m), (width_m, height_m), (rows, columns) = _frame(frames[number % 2])
        wanted = {"pixelHeight": rows, "pixelWidth": columns, "width": width_m * 1e6, "height": height_m * 1e6}
        wanted |= {"offsetX": x_m * 1e6, "offsetY": y_m * 1e6, "rotation": 0}
        do(f"spm.scan.setScanGeometry({json.dumps(wanted)})")
        client.query_geometry()

    with closing(client.socket):
        yield {ASKED: lambda _: do("spm.scan.rate;"), SET: set_bias, FRAME: set_frame}


CLIENTS = {"nanonis": nanonis, "park": park}
