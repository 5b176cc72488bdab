"""Preflight: the simulated run of a plan that an agent asks for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from afspm.basics import AfspmError, Plain
from afspm.night import ScanSummary
from afspm.plugins.web.gateway import views
from afspm.plugins.web.gateway.problems import RefusalCode, RefusedRequest
from afspm.plugins.web.gateway.services import READER
from afspm_agents.plan import Plan
from afspm_agents.simulated_run import simulate
from afspm_agents.twin import LONGEST_S
from afspm_agents.workplace import Workplace

MOST_AT_ONCE = 1


class Preflight:
    """Runner of simulations of plans; a simultaneous second simulation is refused."""

    def __init__(self, longest_s: float = LONGEST_S) -> None:
        self._longest_s = longest_s
        self._running = 0

    async def of(self, plan: Plan, place: Workplace, who: str) -> tuple[Plain, bytes | None]:
        """Simulate a plan; return the result, and the picture of its first scan as PNG (None without a picture).

        Raises:
            RefusedRequest: another preflight is running, or the simulation takes too long or fails.
        """
        if self._running >= MOST_AT_ONCE:
            raise RefusedRequest(RefusalCode.TOO_MANY, "another preflight is running; try again later")
        self._running += 1
        try:
            return await self._simulate(plan, place, who)
        except AfspmError as error:
            raise RefusedRequest(RefusalCode.FAILED, str(error)) from error
        finally:
            self._running -= 1

    async def _simulate(self, plan: Plan, place: Workplace, who: str) -> tuple[Plain, bytes | None]:
        speed = await place.do(READER, lambda commands: commands.get("scan-speed"))
        value = views.parameter_model("scan-speed", speed).value if speed.ok else None
        with place.watch.reading() as overview:
            scans = list(overview.scans)

        def values(scan: ScanSummary) -> NDArray[np.float64] | None:
            with place.watch.reading():
                frame = place.watch.frames.kept(scan.time_ns, scan.channel)
            frame = frame or place.archive.frame(scan.time_ns, scan.channel)
            return None if frame is None else frame.values

        return await simulate(
            plan, who, frame=place.frame, run_dir=place.run_dir, scans=scans, values=values,
            speed_m_s=value if isinstance(value, float) else None, longest_s=self._longest_s,
        )  # fmt: skip
