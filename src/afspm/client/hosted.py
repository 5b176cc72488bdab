"""`HostedComponent`: what the loop asks of a component, and the attributes that it gives to one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

if TYPE_CHECKING:
    from afspm.basics.clock import Clock
    from afspm.client.scope import Scope
    from afspm.model import Packet
    from afspm.storage.memory import Memory


class HostedComponent(Protocol):
    """A component as its loop sees it; see `Component` for what each member means."""

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
