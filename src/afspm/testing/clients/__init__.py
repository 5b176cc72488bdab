"""Conformance suite for clients: a client in any language takes part in real and scripted experiments.

`afspm test-client -- COMMAND` starts the client's conformance program, sends it steps, and compares its actions and
answers with published packets and sent requests. `docs/reference/client-conformance.md` describes the program.
"""

from __future__ import annotations

from afspm.testing.clients.runner import ClientReport, judge

__all__ = ["ClientReport", "judge"]
