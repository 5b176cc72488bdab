"""While a scan runs: what would disturb it is refused, what only asks is answered."""

from __future__ import annotations

from afspm.model import ControlRequest, ControlResponse, Parameter, ProbePosition, ScopeState, names
from afspm.testing.translators.bench import answer_in_words
from afspm.testing.translators.registry import check
from afspm.testing.translators.story import told
from afspm.testing.translators.taking import Taking
from afspm.testing.translators.verdicts import expect

_NEEDS = (names.START_SCAN, names.STOP_SCAN)


@check("busy/refused", "while a scan runs what would disturb it is REP_NOT_FREE, and it goes on", needs=_NEEDS)
def refused(kit: Taking) -> None:
    mark = kit.begin_long_scan(kit.frames.other)
    asked: list[tuple[ControlRequest, object, str, tuple[str, ...]]] = [
        (ControlRequest.ACTION, names.START_SCAN, "start-scan", ()),
        (ControlRequest.ACTION, names.START_SPEC, "start-spec", (names.START_SPEC,)),
        (ControlRequest.SET_SCAN_PARAMS, kit.frames.plain.request(kit.support), "setting a frame", ()),
        (
            ControlRequest.SET_PROBE_POS,
            ProbePosition(kit.frames.plain.region.center_m),
            "moving the probe",
            (names.PROBE_POS_X, names.PROBE_POS_Y),
        ),
    ]
    for kind, subject, what, needs in asked:
        if kit.support.has(*needs):
            _require_running(kit, mark)
            response = kit.bench.ask_directly(kind, subject)
            expect(
                response.code == ControlResponse.NOT_FREE, f"REP_NOT_FREE to {what} while SS_SCANNING",
                answer_in_words(response),
            )  # fmt: skip
    _require_running(kit, mark)
    heard = [one for one in kit.bench.story.since(mark) if one.state is None]
    expect(not heard, "nothing but SS_SCANNING while what was asked was refused", told(heard))


@check("busy/answered", "while a scan runs, parameters are told and support of actions is answered", needs=_NEEDS)
def answered(kit: Taking) -> None:
    mark = kit.begin_long_scan(kit.frames.other)
    name = next((one for one, value in kit.support.parameters.items() if value is not None), None)
    asked: list[tuple[ControlRequest, object, str]] = []
    if kit.support.actions[names.STOP_SCAN] is not None:
        asked.append((ControlRequest.ACTION_SUPPORT, names.STOP_SCAN, "asking for stop-scan"))
    if name is not None:
        asked.append((ControlRequest.PARAM, Parameter(name), f"getting {name}"))
    for kind, subject, what in asked:
        response = kit.bench.ask(kind, subject)
        expect(response.ok, f"REP_SUCCESS to {what} while SS_SCANNING", answer_in_words(response))
    _require_running(kit, mark)


def _require_running(kit: Taking, mark: int) -> None:
    state = kit.bench.state
    expect(state is ScopeState.SCANNING, "a scan that goes on", told(kit.bench.story.since(mark)))
