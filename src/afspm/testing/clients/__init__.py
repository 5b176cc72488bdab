"""Conformance suite for clients: a client in any language takes part in real and scripted experiments.

`afspm test-client -- COMMAND` starts the client's conformance program, sends it steps, and compares its actions and
answers with published packets and sent requests. `docs/reference/client-conformance.md` describes the program.

One judge outside replaces tests in each language, which only test what their author thought of. A recorded session
can't be replayed, since ids, times and the order of answers rightly differ between clients. Half of the checks have a
scripted scheduler, where every byte is known; the others have real processes, since only they show that a scan survives
a kill. The judge is tested with variants of a client that are broken in one way each.
"""

from __future__ import annotations

from afspm.testing.clients.runner import ClientReport, judge

__all__ = ["ClientReport", "judge"]
