"""The simulated run of a plan in a separate process that can't disturb the experiment.

The agent's server simulates a plan for the agent (`preflight`). What a person reads before approving is simulated
again by the person's own program (`repeated`): the agent's server could publish any result.
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from afspm.basics import AfspmError, Plain
from afspm.components import Array, robust_spread
from afspm.model import Frame, ProblemNames
from afspm.night import ScanSummary
from afspm.plugins.web.archive import Archive
from afspm_agents.plan import Plan
from afspm_agents.twin import LONGEST_S

Values = Callable[[ScanSummary], Array | None]
"""Returns the values of a scan; None if they are no longer known."""


async def simulate(
    plan: Plan,
    who: str,
    *,
    frame: Frame,
    run_dir: Path,
    scans: Iterable[ScanSummary],
    values: Values,
    speed_m_s: float | None,
    longest_s: float = LONGEST_S,
) -> tuple[Plain, bytes | None]:
    """Simulate a plan; return the result, and the picture of its first scan as PNG (None without a picture).

    Args:
        run_dir: the run folder, with the limits.
        scans: scans of the run; the widest of the newest is the sample.
        speed_m_s: the scan speed in force; None: a usual one.

    Raises:
        AfspmError: the simulation takes too long or fails.
    """
    with TemporaryDirectory(prefix="afspm-preflight-") as temporary:
        folder = Path(temporary)
        request, result = folder / "request.json", folder / "result.json"
        sample = await asyncio.to_thread(_sample, scans, values, folder)
        asked = {
            "plan": plan.canonical(), "frame": frame.name, "who": who, "folder": str(run_dir), "sample": sample,
            "speed_m_s": speed_m_s,
        }  # fmt: skip
        request.write_text(json.dumps(asked), encoding="utf-8")
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "afspm_agents.twin", str(request), str(result), str(folder),
            stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        try:
            _, errors = await asyncio.wait_for(process.communicate(), longest_s)
        except TimeoutError:
            raise AfspmError(f"the simulation took longer than {longest_s:g} s; propose a smaller plan") from None
        finally:
            if process.returncode is None:  # also if the call was cancelled
                process.kill()
                await process.wait()
        if process.returncode != 0 or not result.exists():
            last = errors.decode(errors="replace").strip().splitlines()[-1:] or ["no result"]
            raise AfspmError(f"the simulation failed: {last[0]}")
        picture = folder / "0.png"
        found: Plain = json.loads(result.read_text(encoding="utf-8"))
        return found, picture.read_bytes() if picture.exists() else None


async def repeated(plan: Plan, who: str, *, frame: Frame, run_dir: Path, speed_m_s: float | None) -> Plain:
    """Return the result of a plan's simulation on the recorded scans, or the reason why there is none as "error"."""
    archive = Archive(run_dir)
    past = await asyncio.to_thread(archive.past, ProblemNames())

    def values(scan: ScanSummary) -> Array | None:
        found = archive.frame(scan.time_ns, scan.channel)
        return None if found is None else found.values

    try:
        found, _ = await simulate(
            plan, who, frame=frame, run_dir=run_dir, scans=() if past is None else past.scans, values=values,
            speed_m_s=speed_m_s,
        )  # fmt: skip
    except AfspmError as error:
        return {"error": str(error)}
    return found


def _sample(scans: Iterable[ScanSummary], values_of: Values, folder: Path) -> Plain:
    # the widest of the newest scans, in heights
    heights = [one for one in scans if one.unit == "m" and not one.interrupted][-20:]
    for scan in sorted(heights, key=lambda one: one.region.size_m[0], reverse=True):
        values = values_of(scan)
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


def _noise_m(values: Array) -> float:
    # from second differences along lines, in which steps and slopes hardly appear;
    # a second difference has 1 + 4 + 1 = 6 times the variance of a pixel
    second = values[:, 2:] - 2.0 * values[:, 1:-1] + values[:, :-2]
    return robust_spread(second) / math.sqrt(6.0)
