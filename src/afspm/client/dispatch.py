"""Delivery of packets to the handlers of a component."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

from afspm import wire
from afspm.basics.errors import WireError
from afspm.model import ControlState, Packet
from afspm.wire.messages import CONTROL_STATE

if TYPE_CHECKING:
    from afspm.basics.clock import Clock
    from afspm.client.experiment_link import PublishedState
    from afspm.client.scope import Scope
    from afspm.storage.memory import Memory


class HostedComponent(Protocol):
    """The interface of a component for its loop; see `Component` for each member."""

    longest_step_s: ClassVar[float]
    period_s: float | None
    period_time: Literal["experiment", "real"]
    scope: Scope
    clock: Clock
    log: logging.Logger
    name: str
    memory: Memory
    run_dir: Path
    simulated: bool
    packet: Packet | None
    _publish: Callable[[Any, str | None], None]

    def run(self) -> None: ...
    def on_start(self) -> None: ...
    def on_problem(self, problem: str, flagged: bool) -> None: ...
    def on_message(self, envelope: str, message: Any) -> None: ...
    def on_tick(self) -> None: ...
    def on_end(self) -> None: ...


class MessageDispatcher:
    """A dispatcher that calls a component's handlers for packets; handlers inherited from `base` do not count.

    Args:
        prefixes: prefixes of the envelopes that the component subscribed to; None: all. Other packets arrive as well,
            since `Scope` needs them.
    """

    def __init__(
        self, component: HostedComponent, base: type, prefixes: tuple[str, ...] | None, log: logging.Logger
    ) -> None:
        self._component = component
        self._base = base
        self._prefixes = prefixes
        self._log = log
        self._problems: frozenset[int] = frozenset()
        self._wanted: dict[str, bool] = {}

    def wants(self, packet: Packet) -> bool:
        """Return whether the component subscribed to a packet and has a handler for it; only such packets are kept."""
        try:
            message = wire.message_of(packet.envelope)
        except WireError:
            return False
        if self._prefixes is not None and not packet.envelope.startswith(self._prefixes):
            return False
        if message not in self._wanted:
            self._wanted[message] = self._wants_message(message)
        return self._wanted[message]

    def never_called(self) -> dict[str, str]:
        """Return the handlers for which no prefix selects a message, each with the name of its message."""
        prefixes = self._prefixes
        if prefixes is None:
            return {}
        unsubscribed = [
            name
            for name in wire.known_messages()
            if not any(name.startswith(prefix) or prefix.startswith(name) for prefix in prefixes)
        ]
        handlers = [(wire.declaration(name).handler, name) for name in unsubscribed]
        if CONTROL_STATE.name in unsubscribed:
            handlers.append(("on_problem", CONTROL_STATE.name))
        return {handler: name for handler, name in handlers if self._has(handler)}

    @property
    def wants_anything(self) -> bool:
        return any(map(self._wants_message, wire.known_messages()))

    def give(self, packet: Packet, view: PublishedState) -> None:
        """Call the handlers for a packet; an unreadable packet is logged and dropped.

        Args:
            view: knows the roles of channels.
        """
        try:
            message = wire.message_of(packet.envelope)
            thing = view.described(wire.decode(message, packet.payload))
        except WireError as error:
            self._log.warning("a packet can't be read: %s", error)
            return
        self._component.packet = packet
        try:
            if (handler := self._handler(message)) is not None:
                handler(packet.envelope, thing)
            if isinstance(thing, ControlState):
                self._give_problems(thing)
        finally:
            self._component.packet = None

    def _give_problems(self, state: ControlState) -> None:
        before, self._problems = self._problems, frozenset(state.problems)
        if self._has("on_problem"):
            for number in sorted(before ^ self._problems):
                self._component.on_problem(self._component.scope.problems.name(number), number in self._problems)

    def _wants_message(self, message: str) -> bool:
        return self._handler(message) is not None or (message == CONTROL_STATE.name and self._has("on_problem"))

    def _handler(self, message: str) -> Callable[[str, object], None] | None:
        name = wire.declaration(message).handler
        if self._has(name):
            handle: Callable[[object], None] = getattr(self._component, name)
            return lambda envelope, thing: handle(thing)
        return self._component.on_message if self._has("on_message") else None

    def _has(self, name: str) -> bool:
        return hasattr(type(self._component), name) and overrides(self._component, self._base, name)


def overrides(thing: object, base: type, name: str) -> bool:
    """Return whether the class of `thing` overrides the attribute `name` of `base`."""
    return getattr(type(thing), name, None) is not getattr(base, name, None)
