"""Where scans say they were taken is where they were: details fit into a larger scan, if there is a sample to see."""

from __future__ import annotations

from afspm.model import names
from afspm.testing.translators.frames import Frame
from afspm.testing.translators.likeness import CLEARLY, LIKE, Picture, best_of, likenesses
from afspm.testing.translators.registry import check
from afspm.testing.translators.taking import Taken, Taking
from afspm.testing.translators.verdicts import Failed, Skipped

_SHAPE = (96, 96)


@check(
    "scan/picture",
    "details fit into a larger scan where they say they are, and as they say they are turned",
    needs=(names.START_SCAN,),
)
def picture(kit: Taking) -> None:
    has_angle = kit.support.has(names.SCAN_ANGLE)
    details = [kit.scan(name) for name in ("plain", "wide", *(["turned"] if has_angle else []))]
    larger = kit.take_scan(Frame(kit.frames.whole, _SHAPE))
    found = [likenesses(*_pictures(channel, larger, details)) for channel in _common(larger, details)]
    if not found:
        raise Failed("the same channels in all scans", "none that all have")
    best = max(found, key=lambda likeness: max(likeness.values()))
    name, likeness = best_of(best)
    as_told = best["as told"]
    if likeness < LIKE:
        raise Skipped(f"no structure is seen in all scans (correlation {likeness:.2f}): noise shows no coordinates")
    if as_told < likeness - CLEARLY:
        raise Failed(
            "details that fit into a larger scan as they are told",
            f"a correlation of {as_told:.2f}, and of {likeness:.2f} {name}",
        )
    if as_told < LIKE:
        raise Skipped(f"no structure is seen clearly in all scans (correlation {as_told:.2f})")


def _common(larger: Taken, details: list[Taken]) -> list[str]:
    sets = [{scan.channel for scan in taken.scans if min(scan.shape) > 1} for taken in (larger, *details)]
    return sorted(set.intersection(*sets))


def _pictures(channel: str, larger: Taken, details: list[Taken]) -> tuple[Picture, list[Picture]]:
    def of(taken: Taken) -> Picture:
        scan = next(one for one in taken.scans if one.channel == channel)
        return Picture(scan.region, scan.values)

    return of(larger), [of(taken) for taken in details]
