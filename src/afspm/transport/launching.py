"""The sockets of a process, as the line that it was launched with says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from afspm.clock import Clock
from afspm.errors import ConfigError
from afspm.transport.network import Network
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort


class LaunchedSockets(Protocol):
    """The part of `afspm.launch.Sockets` that is needed here."""

    @property
    def publish(self) -> str | None: ...
    @property
    def subscribe(self) -> Sequence[str]: ...
    @property
    def serve(self) -> str | None: ...
    @property
    def control(self) -> str | None: ...


class Launched(Protocol):
    """The part of `afspm.launch.Launch` that is needed here."""

    @property
    def name(self) -> str: ...
    @property
    def sockets(self) -> LaunchedSockets: ...
    @property
    def envelopes(self) -> Sequence[str] | None: ...
    @property
    def keys(self) -> Mapping[str, Any] | None: ...


def open_port(launch: Launched, clock: Clock) -> ZmqPort:
    """The port of a component. Raises TransportError."""
    sockets = launch.sockets
    return ZmqPort(
        Network.from_launch(launch.name, launch.keys),
        launch.name,
        clock,
        subscribe=sockets.subscribe,
        envelopes=launch.envelopes,
        control=sockets.control,
        publish=sockets.publish,
    )


def open_server_port(launch: Launched, clock: Clock) -> ZmqServerPort:
    """The port of a translator. Raises TransportError, or ConfigError if it has no address to answer on."""
    if launch.sockets.serve is None:
        raise ConfigError("it has no address to answer requests on", where=launch.name, hint="serve = address")
    return ZmqServerPort(
        Network.from_launch(launch.name, launch.keys),
        clock,
        serve=launch.sockets.serve,
        publish=launch.sockets.publish,
        allowed=(launch.keys or {}).get("scheduler") or None,
    )
