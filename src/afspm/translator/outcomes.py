"""Which requests have been carried out, so that none is carried out twice, also over a kill of the process."""

from __future__ import annotations

import base64
import hashlib
from typing import Any

from afspm.model import ControlResponse, Request, Response

CAPACITY = 300


class RequestOutcomes:
    """The outcomes of the last requests that had an id.

    Args:
        kept: the part of the translator's memory that this is written to; whoever owns it saves it, with every request.
            So an entry is a text, which is quickly written: what was asked, and once it is known what came of it.
        all_or_nothing: the microscope's own state is saved together with the ledger: what has no outcome here
            was not done. Otherwise a request that was begun and has no outcome may have been done.
    """

    def __init__(self, kept: dict[str, Any], *, all_or_nothing: bool) -> None:
        self._kept: dict[str, str] = kept
        if all_or_nothing:
            for request_id in [key for key, entry in self._kept.items() if " " not in entry]:
                del self._kept[request_id]

    def outcome(self, request: Request) -> Response | None:
        """How the request was answered before; None if it is new."""
        entry = self._kept.get(request.id) if request.id else None
        if entry is None:
            return None
        asked, _, outcome = entry.partition(" ")
        if asked != _fingerprint(request):
            reason = "its id was used for another request before"
            return Response(ControlResponse.FAILURE, reason=reason, id=request.id)
        if not outcome:
            reason = "the translator was restarted while it carried this out: whether it was done is not known"
            return Response(ControlResponse.NO_RESPONSE, reason=reason, id=request.id)
        code, payload, reason = outcome.split(" ", 2)
        return Response(int(code), base64.b64decode(payload), reason, request.id)

    def begin(self, request: Request) -> None:
        """The request is going to be carried out."""
        if request.id:
            self._kept[request.id] = _fingerprint(request)
            while len(self._kept) > CAPACITY:
                del self._kept[next(iter(self._kept))]

    def finish(self, request: Request, response: Response) -> None:
        """The request was carried out, with this outcome."""
        if request.id:
            payload = base64.b64encode(response.payload).decode()
            self._kept[request.id] = f"{_fingerprint(request)} {int(response.code)} {payload} {response.reason}"

    def forget(self, request: Request) -> None:
        """Nothing of the request was done: it may be asked again."""
        self._kept.pop(request.id, None)


def _fingerprint(request: Request) -> str:
    return hashlib.sha256(bytes([request.kind]) + request.payload).hexdigest()[:16]
