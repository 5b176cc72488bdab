"""Baseline agents without any skill."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from afspm.basics import RequestError
from afspm.model import Region
from afspm_bench.session import TrialSession


class Idle:
    """Agent that does nothing and reports nothing."""

    def solve(self, session: TrialSession) -> None:
        pass


class Random:
    """Agent that makes random legal calls, and reports at random."""

    def solve(self, session: TrialSession) -> None:
        random, scope, cites = np.random.default_rng(session.seed), session.scope, []
        for _ in range(int(random.integers(1, 6))):
            x, y = (float(one) for one in random.uniform(-1e-6, 1e-6, 2))
            with suppress(RequestError):
                if random.random() < 0.6:
                    size_m = float(random.uniform(0.2e-6, 1.5e-6))
                    cites.append(scope.scan(Region((x, y), (size_m, size_m)), shape=(32, 32), timeout_s=20.0).time_ns)
                elif random.random() < 0.5:
                    scope.set("scan-speed", float(random.uniform(2e-6, 2e-5)), timeout_s=20.0)
                else:
                    cites.append(scope.spectrum((x, y), timeout_s=20.0).time_ns)
        status = str(random.choice(["done", "cannot", "ask"]))
        number = {"value": float(random.uniform(0, 1e-9)), "error": float(random.uniform(0, 1e-10))}
        session.report(status, dict.fromkeys(("constant", "height", "gap", "vx", "vy"), number), cites)
