"""Conformance suite for clients: a client in any language takes part in real and scripted experiments.

`afspm test-client -- COMMAND` starts the client's conformance program, gives it steps, and compares what it does and
tells with what was published and sent. `docs/reference/client-conformance.md` is the page for those who write one.
"""

from __future__ import annotations

from afspm.testing.clients.runner import ClientReport, judge

__all__ = ["ClientReport", "judge"]
