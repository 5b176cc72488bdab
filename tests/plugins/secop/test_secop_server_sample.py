"""The sample server for instruments of a user's own Python, against the client of afspm."""

from __future__ import annotations

import importlib.util
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from deadlines import DEADLINE_S

from afspm.model import ControlResponse, InstrumentOrder, InstrumentReading, Parameter
from afspm.plugins.secop.instrument import LineSocket
from afspm.plugins.secop.secop_client import SecopClient

SAMPLE = Path(__file__).parents[3] / "experiments" / "serve_as_secop" / "secop_server.py"


class Magnet:
    """A stand-in for a driver: setting blocks until `let_go`."""

    def __init__(self) -> None:
        self.tesla = 0.5
        self.let_go = threading.Event()

    def field(self) -> float:
        return self.tesla

    def set_field(self, tesla: float) -> None:
        assert self.let_go.wait(DEADLINE_S)
        if tesla == 0.25:
            raise OSError("quench")
        self.tesla = tesla


def loaded() -> ModuleType:
    spec = importlib.util.spec_from_file_location("secop_server", SAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class SecopBench:
    """The client, connected to the sample server over TCP."""

    def __init__(self, port: int, modules: Mapping[str, str]) -> None:
        self.lines = LineSocket("127.0.0.1", port)
        self.client = SecopClient(modules)
        self.lines.send(self.client.connected(time.monotonic()))

    def pump(self) -> None:
        for line in self.lines.receive():
            self.lines.send(self.client.take(line, time.monotonic()))
        self.lines.send(self.client.tick(time.monotonic()))

    def readings(self) -> dict[str, InstrumentReading]:
        return {one.name: one for one in self.client.readings(time.monotonic())}

    def until(self, holds: Callable[[], object]) -> None:
        until_s = time.monotonic() + DEADLINE_S
        while not holds():
            assert time.monotonic() < until_s
            self.pump()
            time.sleep(0.01)

    def order(self, number: int, name: str, value: str, unit: str = "T") -> tuple[int, str]:
        order = InstrumentOrder(number, f"id-{number}", Parameter(name, value, unit))
        self.lines.send(self.client.order(order, time.monotonic()))
        self.until(lambda: any(one.number == number for one in self.client.outcomes()))
        (found,) = [one for one in self.client.outcomes() if one.number == number]
        return found.response, found.reason


@pytest.fixture
def magnet() -> Magnet:
    return Magnet()


@pytest.fixture
def bench(magnet: Magnet) -> Iterator[SecopBench]:
    sample: Any = loaded()
    modules = {
        "mf": sample.Module("magnet", "T", get=magnet.field, set=magnet.set_field, bounds=(-2.0, 2.0)),
        "level": sample.Module("helium", "%", get=lambda: 1 / 0 if magnet.tesla > 1.5 else 80.0),
    }
    with sample.Server(modules, port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        made = SecopBench(server.server_address[1], {"m.field": "mf", "m.level": "level"})
        made.until(lambda: all(one.value is not None for one in made.readings().values()))
        yield made
        made.lines.close()
        magnet.let_go.set()
        server.shutdown()


def test_blocking_driver_is_busy_until_it_has_arrived(bench: SecopBench, magnet: Magnet) -> None:
    assert bench.order(1, "m.field", "1000", "mT") == (ControlResponse.SUCCESS, "")
    assert (bench.readings()["m.field"].target, bench.readings()["m.field"].busy) == (1.0, True)
    assert bench.readings()["m.field"].value == 0.5
    response, reason = bench.order(2, "m.field", "0.7")
    assert (response, "on its way to 1.0" in reason) == (ControlResponse.PARAM_ERROR, True)
    magnet.let_go.set()
    bench.until(lambda: bench.readings()["m.field"].value == 1.0 and not bench.readings()["m.field"].busy)


def test_server_refuses_and_names_the_reason(bench: SecopBench) -> None:
    assert "must be between -2.0 and 2.0" in bench.order(1, "m.field", "3")[1]
    assert "can only be read" in bench.order(2, "m.level", "3", "%")[1]
    assert "has no unit" in bench.order(4, "m.field", "1", "")[1]


def test_error_of_a_driver_makes_its_value_unknown(bench: SecopBench, magnet: Magnet) -> None:
    magnet.let_go.set()
    assert bench.order(1, "m.field", "0.25")[0] == ControlResponse.SUCCESS
    bench.until(lambda: "quench" in bench.readings()["m.field"].reason)
    assert bench.readings()["m.field"].value is None
    magnet.tesla = 1.8
    bench.until(lambda: "ZeroDivisionError" in bench.readings()["m.level"].reason)


def test_reset_connection_is_no_error_of_the_server() -> None:
    errors, is_over = list[object](), threading.Event()
    sample: Any = loaded()
    with sample.Server({}, port=0) as server:
        server.handle_error = lambda *given: errors.append(given)
        close_request = server.close_request

        def close(request: socket.socket) -> None:
            close_request(request)
            is_over.set()

        server.close_request = close
        threading.Thread(target=server.serve_forever, daemon=True).start()
        client = socket.create_connection(server.server_address)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # close() sends a reset
        client.close()
        assert is_over.wait(DEADLINE_S)
        server.shutdown()
    assert not errors
