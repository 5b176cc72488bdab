"""`Instrument`: the component that connects an experiment to one SECoP server."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import ClassVar, Literal
from urllib.parse import urlsplit

from afspm import Component
from afspm.basics import ConfigError, ExperimentClock, TransportError
from afspm.model import InstrumentReadings
from afspm.plugins.secop import lines
from afspm.plugins.secop.channel import ServerUnfit
from afspm.plugins.secop.lines import LONGEST
from afspm.plugins.secop.secop_client import SecopClient

PORT = 10767
AGAIN_S = 2.0
CONNECT_S = 1.0
DESCRIBED_S = 5.0
PATIENCE_S = 0.2
"""Real time for which the scheduler keeps the answer to a report until it has an order, or the server an answer to an
order. Meanwhile the lines of the server wait."""
LONGEST_TICK_S = 1.0
GOES_ON_WITHIN_S = 60.0
"""Real time after which a restarted process does not continue steps of a target: a person may have seen them halt."""
_KEPT_AGAIN_S = 20.0  # real time: unchanged steps must not look older than GOES_ON_WITHIN_S after a kill
_STEPS = "steps"


class Instrument(Component):
    """Another instrument of the experiment: a cryostat, a magnet, a lock-in amplifier … at a SECoP server.

    Its parameters are set and read like parameters of the microscope, and [limits] and [conditions] apply to them.

    Args:
        address: the address of the server: "secop://cryo-pc:10767".
        parameters: the parameters of the experiment, each with its module: `"cryo.temperature" = "tt"`, or with one
            accessible of a module, `"lockin.sensitivity" = "sr830:sensitivity"`. A name begins with the name of this
            component and a dot.
    """

    is_instrument: ClassVar[bool] = True
    listens: ClassVar[tuple[str, ...]] = ("ControlState",)
    period_s = 0.05  # a tick of an idle instrument takes PATIENCE_S
    period_time: Literal["experiment", "real"] = "real"

    def __init__(self, address: str, parameters: dict[str, str]) -> None:
        self._host, self._port = _host_and_port(address)
        if not parameters:
            raise ConfigError("the instrument has no parameters", where="parameters", hint='"cryo.temperature" = "tt"')
        self._client = SecopClient(parameters)
        self._lines: LineSocket | None = None
        self._again_s = 0.0
        self._last_fault = ""
        self._token = 0

    def try_connection(self) -> str:
        """Connect to the server, and compare its description with the parameters.

        Raises:
            TransportError: no SECoP server answers, or the server lacks a module.
        """
        where = f"{self._host}:{self._port}"
        try:
            description = _description_of(self._host, self._port, SecopClient(self._client.wanted))
        except ServerUnfit as error:
            hint = "correct `address` or `parameters` in the experiment file"
            raise TransportError(str(error), where=where, hint=hint) from error
        except OSError as error:
            hint = "start the server, or correct `address`; a firewall must accept the port"
            raise TransportError(f"no SECoP server answers: {error}", where=where, hint=hint) from error
        server = " ".join(str(description.get("equipment_id") or "without a name").split())
        return f"{where} is the SECoP server {server[:80]}, and has {', '.join(self._client.wanted)}"

    def on_start(self) -> None:
        """Continue the steps of a target that the kill of an earlier process has interrupted."""
        kept = self.memory.get(_STEPS) or {}
        if not kept.get("of"):
            return
        names = ", ".join(kept["of"])
        if self._real_s_since(kept["at_ns"]) > GOES_ON_WITHIN_S:
            self.log.warning("the steps of %s ended with the process before: set the target again", names)
            return
        self.log.info("going on with the steps of %s", names)
        self._client.go_on_with(kept["of"])

    def on_tick(self) -> None:
        """Exchange lines with the server and report to the scheduler, as long as there are orders."""
        until_s = self.clock.monotonic_s() + LONGEST_TICK_S
        while self._exchange() and self._client.is_working and self.clock.monotonic_s() < until_s:
            pass

    def _exchange(self) -> bool:
        # returns whether the scheduler had orders
        self._serve(self._receive)
        self._serve(lambda: self._client.tick(self.clock.monotonic_s()))
        self._await_outcome()
        for text in self._client.log:
            self.log.warning("%s", text)
        self._client.log.clear()
        self._keep_steps()
        return self._report()

    def _await_outcome(self) -> None:
        until_s = self.clock.monotonic_s() + PATIENCE_S
        while self._client.is_working and self._lines is not None:
            left_s = until_s - self.clock.monotonic_s()
            if left_s <= 0.0 or not self._lines.wait(left_s):
                return
            self._serve(self._receive)

    def on_end(self) -> None:
        """Disconnect; the server keeps the targets (setpoints) of its modules, and steps of a target halt."""
        if steps := self._client.unfinished():
            self.log.warning("the steps of %s halt here: set the target again", ", ".join(steps))
        self.memory.pop(_STEPS, None)
        if self._lines is not None:
            self._lines.close()

    def _report(self) -> bool:
        client = self._client
        outcomes = client.outcomes()
        readings = client.readings(self.clock.monotonic_s())
        patience_s = 0.0 if client.is_working else PATIENCE_S
        report = InstrumentReadings(self.clock.now_ns(), self.name, readings, outcomes, self._token, patience_s)
        answer = self.scope.report_readings(report)
        client.delivered(outcomes)
        self._token = answer.token
        for order in answer.orders:
            self._serve(lambda order=order: client.order(order, self.clock.monotonic_s()))  # type: ignore[misc]
        return bool(answer.orders)

    def _keep_steps(self) -> None:
        kept, steps = self.memory.get(_STEPS) or {"of": {}, "at_ns": 0}, self._client.unfinished()
        if steps != kept["of"] or (steps and self._real_s_since(kept["at_ns"]) > _KEPT_AGAIN_S):
            self.memory[_STEPS] = {"at_ns": self.clock.now_ns(), "of": steps}

    def _real_s_since(self, time_ns: int) -> float:
        return self.clock.real_s((self.clock.now_ns() - time_ns) * 1e-9)

    def _receive(self) -> list[str]:
        now_s, out = self.clock.monotonic_s(), list[str]()
        if self._lines is None:
            if now_s < self._again_s:
                return []
            self._again_s = now_s + AGAIN_S
            self._lines = LineSocket(self._host, self._port)
            return self._client.connected(now_s)
        for line in self._lines.receive():
            out += self._client.take(line, now_s)
        if self._client.is_silent(now_s):
            raise ConnectionError("the server answers nothing")
        if self._client.is_described and self._last_fault:
            self.log.info("%s:%d answers again", self._host, self._port)
            self._last_fault = ""
        return out

    def _serve(self, step: Callable[[], list[str]]) -> None:
        try:
            out = step()
            if self._lines is not None and out:
                self._lines.send(out)
        except (OSError, ServerUnfit) as error:
            if self._lines is not None:
                self._lines.close()
            self._lines = None
            fault = f"{self._host}:{self._port}: {error}"
            self._client.lost(fault)
            if fault != self._last_fault:  # once: it is tried again all the time
                self.log.warning("%s; trying again", fault)
            self._last_fault = fault


class LineSocket:
    """TCP connection that exchanges lines and blocks only while connecting.

    Raises:
        OSError: there is no connection; also raised by `receive` and `send`.
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), CONNECT_S)
        self._socket.settimeout(0.0)
        self._in = self._out = b""

    def receive(self) -> list[str]:
        """Return the complete lines received so far; also send unsent data."""
        self._flush()
        while True:
            try:
                chunk = self._socket.recv(1 << 16)
            except BlockingIOError:
                break
            if not chunk:
                raise ConnectionError("the server has closed the connection")
            self._in += chunk
            if len(self._in) > LONGEST:
                raise ConnectionError("a line without end")
        *whole, self._in = self._in.split(b"\n")
        return [line.decode("utf-8", "replace") for line in whole if line.strip()]

    def wait(self, within_s: float) -> bool:
        """Wait for data of the server, at most for `within_s`; return whether there is some."""
        return bool(select.select([self._socket], [], [], within_s)[0])

    def send(self, lines: list[str]) -> None:
        self._out += "".join(f"{line}\n" for line in lines).encode()
        if len(self._out) > LONGEST:
            raise ConnectionError("the server reads nothing")
        self._flush()

    def close(self) -> None:
        with suppress(OSError):
            self._socket.close()

    def _flush(self) -> None:
        with suppress(BlockingIOError):
            while self._out:
                self._out = self._out[self._socket.send(self._out) :]


def _description_of(host: str, port: int, client: SecopClient) -> Mapping[str, object]:
    clock, answered = ExperimentClock.real(), "nothing"
    connection = LineSocket(host, port)
    try:
        now_s = clock.monotonic_s()
        until_s = now_s + DESCRIBED_S
        connection.send(client.connected(now_s))
        while (left_s := until_s - clock.monotonic_s()) > 0.0:
            connection.wait(left_s)
            for text in connection.receive():
                answered = repr(text.strip()[:80])
                client.take(text, clock.monotonic_s())
                line = lines.parse(text)
                if client.is_described and line is not None and isinstance(line.data, dict):
                    return line.data
    finally:
        connection.close()
    raise TimeoutError(f"no description within {DESCRIBED_S:g} s, and {answered} last")


def _host_and_port(address: str) -> tuple[str, int]:
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port or PORT
    except ValueError:
        host = None
    if host is None or parts.scheme != "secop":
        raise ConfigError(f"{address!r} is no address of a SECoP server", where="address", hint="secop://cryo-pc:10767")
    return host, port
