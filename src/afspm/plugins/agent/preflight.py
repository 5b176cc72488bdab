"""Preflight: the simulated run of a plan, in a separate process that can't disturb the experiment."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from afspm.basics.plain_data import Plain
from afspm.plugins.agent.plan import Plan
from afspm.plugins.agent.twin import LONGEST_S
from afspm.plugins.agent.workplace import Workplace
from afspm.plugins.web.gateway import views
from afspm.plugins.web.gateway.problems import RefusalCode, RefusedRequest
from afspm.plugins.web.gateway.services import READER
from afspm.record.overview import ScanSummary

MOST_AT_ONCE = 1


class Preflight:
    """Runner of simulations of plans, each in a separate process; a simultaneous second simulation is refused."""

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
            with TemporaryDirectory(prefix="afspm-preflight-") as folder:
                return await self._simulate(plan, place, who, Path(folder))
        finally:
            self._running -= 1

    async def _simulate(self, plan: Plan, place: Workplace, who: str, folder: Path) -> tuple[Plain, bytes | None]:
        request, result = folder / "request.json", folder / "result.json"
        sample = await asyncio.to_thread(_sample, place, folder)
        speed = await place.do(READER, lambda commands: commands.get("scan-speed"))
        value = views.parameter_model("scan-speed", speed).value if speed.ok else None
        asked = {
            "plan": plan.canonical(), "frame": place.frame.name, "who": who, "folder": str(place.run_dir),
            "sample": sample, "speed_m_s": value if isinstance(value, float) else None,
        }  # fmt: skip
        request.write_text(json.dumps(asked), encoding="utf-8")
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "afspm.plugins.agent.twin", str(request), str(result), str(folder),
            stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        try:
            _, errors = await asyncio.wait_for(process.communicate(), self._longest_s)
        except TimeoutError:
            raise RefusedRequest(
                RefusalCode.FAILED, f"the simulation took longer than {self._longest_s:g} s; propose a smaller plan"
            ) from None
        finally:
            if process.returncode is None:  # also if the call was cancelled
                process.kill()
                await process.wait()
        if process.returncode != 0 or not result.exists():
            last = errors.decode(errors="replace").strip().splitlines()[-1:] or ["no result"]
            raise RefusedRequest(RefusalCode.FAILED, f"the simulation failed: {last[0]}")
        picture = folder / "0.png"
        found: Plain = json.loads(result.read_text(encoding="utf-8"))
        return found, picture.read_bytes() if picture.exists() else None


def _sample(place: Workplace, folder: Path) -> Plain:
    # the widest of the newest scans, in heights
    with place.watch.reading() as overview:
        heights = [one for one in overview.scans if one.unit == "m" and not one.interrupted][-20:]
    for scan in sorted(heights, key=lambda one: one.region.size_m[0], reverse=True):
        values = _values(place, scan)
        if values is None or min(values.shape) < 8 or not np.isfinite(values).all():
            continue
        np.save(folder / "sample.npy", values)
        low, high = float(values.min()), float(values.max())
        if high <= low:
            continue
        surface = {
            "kind": "file", "path": str(folder / "sample.npy"), "width_m": scan.region.size_m[0],
            "height_range_m": high - low,
        }  # fmt: skip
        return {
            "surface": surface, "center_m": list(scan.region.center_m), "noise_m": _noise_m(values),
            "of": f"the scan {scan.time_ns}",
        }  # fmt: skip
    return {"of": "no overview was measured: steps as a stand-in"}


def _values(place: Workplace, scan: ScanSummary) -> NDArray[np.float64] | None:
    with place.watch.reading():
        frame = place.watch.frames.kept(scan.time_ns, scan.channel)
    frame = frame or place.archive.frame(scan.time_ns, scan.channel)
    return None if frame is None else frame.values


def _noise_m(values: NDArray[np.float64]) -> float:
    # from second differences along lines, in which steps and slopes hardly appear. 1.4826 converts the median absolute
    # deviation to a standard deviation; a second difference has 1 + 4 + 1 = 6 times the variance of a pixel
    second = values[:, 2:] - 2.0 * values[:, 1:-1] + values[:, :-2]
    return float(1.4826 * np.median(np.abs(second - np.median(second))) / np.sqrt(6.0))
