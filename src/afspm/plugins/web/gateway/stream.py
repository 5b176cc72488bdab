"""Events as a stream of server-sent events, each client at its own pace from one history."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Collection

from afspm.plugins.web.gateway.events import EventHistory
from afspm.plugins.web.gateway.models import END, MISSED
from afspm.plugins.web.watch import Bell, Watch

ALIVE_S = 10.0  # interval of comments, so that proxies keep the connection
AT_ONCE = 200
RETRY_MS = 1000
MOST_STREAMS = 64


async def server_sent(
    history: EventHistory, watch: Watch, bell: Bell, after_ns: int, kinds: Collection[str]
) -> AsyncIterator[str]:
    """Yield all events after a time until the experiment ends, as text.

    A slow client delays only its own stream: events that have left the history are reported as `missed`.
    """
    yield f"retry: {RETRY_MS}\n\n"
    while True:
        is_over = watch.ended
        batch = history.after(after_ns, kinds, AT_ONCE)
        if batch.missed_until_ns is not None:
            missed = {"after": str(after_ns), "until": str(batch.missed_until_ns)}
            yield _event(str(max(after_ns, 0)), MISSED, json.dumps({"time": None, "data": missed}))
        # one piece for all: each piece is a write to the socket
        if batch.events:
            yield "".join(_event(str(one.time_ns), one.kind, one.text) for one in batch.events)
        is_behind = batch.newest_ns > after_ns
        after_ns = batch.newest_ns
        if is_over and not is_behind:
            yield _event(str(max(after_ns, 0)), END, json.dumps({"time": None, "data": {}}))
            return
        if not is_behind and not await bell.wait(ALIVE_S):
            yield ": alive\n\n"


def _event(id_: str, kind: str, text: str) -> str:
    return f"id: {id_}\nevent: {kind}\ndata: {text}\n\n"


class StreamCount:
    """The number of open streams, bounded because each takes memory and time."""

    def __init__(self) -> None:
        self._open = 0

    @property
    def is_full(self) -> bool:
        return self._open >= MOST_STREAMS

    async def counted(self, stream: AsyncIterator[str]) -> AsyncIterator[str]:
        """Yield from a stream, which counts as open meanwhile."""
        self._open += 1
        try:
            async for one in stream:
                yield one
        finally:
            self._open -= 1
