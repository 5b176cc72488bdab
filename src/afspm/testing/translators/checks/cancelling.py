"""A scan that is broken off."""

from __future__ import annotations

from afspm.model import ScopeState, names
from afspm.testing.translators.registry import check
from afspm.testing.translators.story import Heard, scans, told
from afspm.testing.translators.taking import Taking
from afspm.testing.translators.verdicts import expect


def states(heard: list[Heard]) -> list[str]:
    """The states among what was heard, in words, each once where it is repeated."""
    found: list[str] = []
    for one in heard:
        if one.state is not None and str(one) not in found[-1:]:
            found.append(str(one))
    return found


def broken_off(kit: Taking, mark: int, stop: str, begun: ScopeState) -> list[Heard]:
    """Stop what runs; what is published from its beginning on, once its states have been found right."""
    asked_to_stop(kit, mark, stop, begun)
    return require_broken_off(kit, mark, stop, begun)


def asked_to_stop(kit: Taking, mark: int, stop: str, begun: ScopeState) -> float:
    """Stop what runs; when that was answered, experiment time in s."""
    bench = kit.bench
    expect(bench.state is begun, f"SS_{begun.name} until it is stopped", told(bench.story.since(mark)))
    kit.act(stop)
    return bench.clock.now_s()


def require_broken_off(kit: Taking, mark: int, stop: str, begun: ScopeState) -> list[Heard]:
    """What is published from the beginning on of what was stopped, once its states have been found right."""
    bench = kit.bench
    bench.wait_state(ScopeState.INTERRUPTED, mark)
    bench.wait_state(ScopeState.FREE, mark, bench.real_s(60.0))
    heard = bench.settled(mark)
    expect(
        states(heard) == [f"SS_{begun.name}", "SS_INTERRUPTED", "SS_FREE"],
        f"SS_{begun.name}, SS_INTERRUPTED, SS_FREE after {stop}",
        told(heard),
    )
    return heard


@check(
    "scan/cancel",
    "stop-scan breaks a scan off: SS_INTERRUPTED, SS_FREE, and no scan",
    needs=(names.START_SCAN, names.STOP_SCAN),
)
def cancel(kit: Taking) -> None:
    heard = broken_off(kit, kit.begin_long_scan(kit.frames.other), names.STOP_SCAN, ScopeState.SCANNING)
    expect(not scans(heard), "no Scan2d of a scan that was stopped", told(heard))


@check("scan/stop-nothing", "stop-scan while nothing runs is a success, and changes nothing", needs=(names.STOP_SCAN,))
def stop_nothing(kit: Taking) -> None:
    kit.bench.come_to_rest()
    mark = kit.bench.story.mark()
    kit.act(names.STOP_SCAN)
    heard = kit.bench.settled(mark)
    expect(not states(heard), "no state after stopping nothing", told(heard))
