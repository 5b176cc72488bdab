"""`SchedulerCore`: all that a scheduler decides, composed of the parts beside this module."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from afspm.logic.events import Codec, Effect, Input
from afspm.model import ControlState, Packet


class SchedulerCore:
    """The scheduler without its sockets.

        core = SchedulerCore(settings, codec)
        core.restore(state); core.restore_cache(packets)     # after a restart only
        effects = core.start(now_s, now_ns)                  # then, for whatever happens:
        effects = core.step(RequestIn(...), now_s, now_ns)

    Whoever hosts it carries out the effects in their order, and calls `step(Tick())` at the latest `wait_s` later.
    """

    def __init__(self, settings: Any, codec: Codec) -> None: ...

    def start(self, now_s: float, now_ns: int) -> list[Effect]:
        """Begin: publishes the control state."""
        raise NotImplementedError

    def step(self, event: Input, now_s: float, now_ns: int) -> list[Effect]:
        """Take in what happened; `now_s` is real and monotonic, `now_ns` the experiment's time."""
        raise NotImplementedError

    def deadline_s(self) -> float | None:
        """When, in real monotonic time, a Tick is due at the latest; None: no deadline."""
        raise NotImplementedError

    def deadline_ns(self) -> int | None:
        """When, in experiment time, a Tick is due at the latest; None: no deadline (only a lease makes one)."""
        raise NotImplementedError

    def snapshot(self) -> dict[str, Any]:
        """What must survive a kill, but for the cache, as plain JSON."""
        raise NotImplementedError

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote, before `start`."""
        raise NotImplementedError

    def restore_cache(self, packets: Iterable[tuple[Packet, int | None]]) -> None:
        """Take up packets that were published (with their `source_ns`), oldest first, before `start`."""
        raise NotImplementedError

    def cached(self) -> Iterable[tuple[Packet, int | None]]:
        """What is cached now (with `source_ns`), oldest first: for whoever tidies the journal."""
        raise NotImplementedError

    @property
    def newest_source_ns(self) -> int:
        """The translator's newest packet that was taken in: where to subscribe from; -1 if there is none."""
        raise NotImplementedError

    @property
    def control_state(self) -> ControlState:
        raise NotImplementedError
