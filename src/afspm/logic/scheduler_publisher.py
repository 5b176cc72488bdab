"""What the scheduler publishes beside what the translator does: control, what happens, and what others tell it."""

from __future__ import annotations

from collections.abc import Callable

from afspm.logic.arbitration import RoleTable, may
from afspm.logic.cache import PacketCache
from afspm.logic.event_log import ENTRIES, EventLog
from afspm.logic.events import Codec, Effect, Log, Publish, RequestIn, SaveState
from afspm.logic.supervisor_registry import SupervisorRegistry
from afspm.model import ControlResponse, ControlState, Response

CONTROL_STATE = "ControlState"


class SchedulerPublisher:
    """Makes packets of the scheduler's own: each has its time before it is published, and that is saved first.

    Args:
        save: says what is to be saved.
    """

    def __init__(
        self, codec: Codec, cache: PacketCache, chronicle: EventLog, roles: RoleTable, save: Callable[[], SaveState]
    ) -> None:
        self.telling = SupervisorRegistry(codec)
        self._codec = codec
        self._cache = cache
        self._event_log = chronicle
        self._roles = roles
        self._save = save

    def control(self, state: ControlState, now_ns: int) -> Publish:
        """The control state as a packet, to be published once it is saved."""
        packet, history = self._cache.stamp(CONTROL_STATE, self._codec.encode(state), now_ns)
        return Publish(packet, None, history)

    def announce(self, envelope: str, payload: bytes, time_ns: int) -> list[Effect]:
        """Whatever there is to say."""
        packet, history = self._cache.stamp(envelope, payload, time_ns)
        return [self._save(), Publish(packet, None, history)]

    def entries(self, now_ns: int) -> list[Effect]:
        """What has happened since the last time."""
        entries = self._event_log.take()
        return self.announce(ENTRIES, self._codec.encode(entries), now_ns) if entries.entries else []

    def told(self, event: RequestIn, now_s: float, now_ns: int) -> tuple[list[Effect], Response]:
        """Somebody has something to publish; a supervisor is told in return what it is to do."""
        envelope, why = self.telling.envelope(event, now_s)
        if not envelope:
            return [], Response(int(ControlResponse.FAILURE), b"", why)
        orders = self._codec.encode_orders(self.telling.orders_for(event.name))
        payload = event.request.subject.payload
        # published already: we were killed before we could answer
        effects = [] if self._cache.holds(envelope, payload) else self.announce(envelope, payload, now_ns)
        return effects, Response(int(ControlResponse.SUCCESS), orders)

    def ordered(self, event: RequestIn, now_s: float) -> tuple[list[Effect], Response]:
        """Somebody wants a process to be started anew."""
        process = str(event.request.subject)
        if may(self._roles.restart, event.name):
            why = self.telling.order(process, now_s)
        else:
            why = f"{event.name} has not the role 'restart' ([control] roles)"
        if why:
            return [], Response(int(ControlResponse.FAILURE), b"", why)
        said = Log("INFO", f"{process} is to be started anew, as {event.name} wishes")
        return [self._save(), said], Response(int(ControlResponse.SUCCESS))
