"""Checks of refusals: unknown names, impossible values, unreachable positions, and requests during a scan."""

from __future__ import annotations

import math

from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    Parameter,
    ProbePosition,
    ScanParameters,
    ScopeState,
    names,
)
from afspm.testing.conformance import expect
from afspm.testing.translators.checks.parameters import require_param_error
from afspm.testing.translators.client import answer_in_words, describe_all
from afspm.testing.translators.measuring import CheckMeasurements
from afspm.testing.translators.translator_suite import check
from afspm.wire import messages

_UNKNOWN = "no-such-thing"


@check("refused/unknown-parameter", "an unknown parameter: REP_PARAM_NOT_SUPPORTED")
def unknown_parameter(kit: CheckMeasurements) -> None:
    for parameter in (Parameter(_UNKNOWN), Parameter(_UNKNOWN, "1", "m")):
        _require(kit, ControlRequest.PARAM, parameter, ControlResponse.PARAM_NOT_SUPPORTED, f"REQ_PARAM {_UNKNOWN}")


@check("refused/unknown-action", "an unknown action: REP_ACTION_NOT_SUPPORTED")
def unknown_action(kit: CheckMeasurements) -> None:
    can_be_asked = None not in kit.support.actions.values()
    for kind in (ControlRequest.ACTION, *([ControlRequest.ACTION_SUPPORT] if can_be_asked else [])):
        _require(kit, kind, _UNKNOWN, ControlResponse.ACTION_NOT_SUPPORTED, f"REQ_{kind.name} {_UNKNOWN}")


def _require(kit: CheckMeasurements, kind: ControlRequest, subject: object, code: ControlResponse, what: str) -> None:
    response = kit.client.ask_directly(kind, subject)
    expect(response.code == code, f"REP_{code.name} to {what}", answer_in_words(response))


@check("refused/read-only", "a read-only parameter is not set", needs=(names.CONTROLLER,))
def read_only(kit: CheckMeasurements) -> None:
    require_param_error(kit, names.CONTROLLER, "mine", None, kit.client.get(names.CONTROLLER))


@check("refused/too-large", "a frame of a kilometre, or of size 0, is refused, not clamped", needs=(names.SCAN_SIZE_X,))
def too_large(kit: CheckMeasurements) -> None:
    kit.client.come_to_rest()
    for name, values in (
        (names.SCAN_SIZE_X, ("1000", "-1e-6", "0")),
        (names.SCAN_SIZE_Y, ("1000", "-1e-6", "0")),
        (names.SCAN_TOP_LEFT_X, ("1000", "-1000")),
        (names.SCAN_TOP_LEFT_Y, ("1000", "-1000")),
        (names.PROBE_POS_X, ("1000",)),
        (names.PROBE_POS_Y, ("-1000",)),
        (names.SCAN_RESOLUTION_X, ("0", "-16", "1000000000")),
        (names.SCAN_RESOLUTION_Y, ("0", "-16", "1000000000")),
    ):
        if kit.support.has(name):
            before = kit.client.get(name)
            unit = None if "resolution" in name else "m"
            for value in values:
                require_param_error(kit, name, value, unit, before)


@check("refused/whole-frame", "a frame that can't be set as a whole changes nothing", needs=(names.SCAN_SIZE_X,))
def whole_frame(kit: CheckMeasurements) -> None:
    message = messages.ScanParameters2d()
    message.spatial.length_units = "m"
    message.spatial.roi.size.x = 0.9 * kit.frames.whole.size_m[0]
    message.spatial.roi.top_left.x = 1000.0
    _require_unchanged(kit, ControlRequest.SET_SCAN_PARAMS, message, ScanParameters, "a frame a kilometre away")


@check("refused/nan", "NaN in a frame, a position or the feedback is refused, and changes nothing")
def nan(kit: CheckMeasurements) -> None:
    if kit.support.has(names.SCAN_TOP_LEFT_X):
        frame = messages.ScanParameters2d()
        frame.spatial.roi.top_left.x = math.nan
        _require_unchanged(kit, ControlRequest.SET_SCAN_PARAMS, frame, ScanParameters, "a frame at NaN")
    if kit.support.has(names.PROBE_POS_X):
        place = messages.ProbePosition()
        place.point.x = math.nan
        _require_unchanged(kit, ControlRequest.SET_PROBE_POS, place, ProbePosition, "the probe at NaN")
    if kit.support.has(names.ZCTRL_IGAIN):
        gain = messages.ZCtrlParameters(integralGain=math.nan)
        _require_unchanged(kit, ControlRequest.SET_ZCTRL_PARAMS, gain, Feedback, "an integral gain of NaN")


@check("refused/unit-of-frame", "a frame in kilograms is refused, and changes nothing", needs=(names.SCAN_SIZE_X,))
def unit_of_frame(kit: CheckMeasurements) -> None:
    message = messages.ScanParameters2d()
    message.spatial.length_units = "kg"
    message.spatial.roi.size.x = 0.9 * kit.frames.whole.size_m[0]
    _require_unchanged(kit, ControlRequest.SET_SCAN_PARAMS, message, ScanParameters, "a frame in kg")


def _require_unchanged(
    kit: CheckMeasurements, kind: ControlRequest, subject: object, published: type, what: str
) -> None:
    client = kit.client
    client.come_to_rest()
    before, mark = client.observations.newest(published), client.observations.mark()
    response = client.ask_directly(kind, subject)
    expect(response.code == ControlResponse.PARAM_ERROR, f"REP_PARAM_ERROR to {what}", answer_in_words(response))
    observed = client.settled(mark)
    expect(client.observations.newest(published) == before, f"nothing changed by {what}", describe_all(observed))


_NEEDS = (names.START_SCAN, names.STOP_SCAN)


@check("busy/refused", "during a scan, requests that would disturb it get REP_NOT_FREE, and it goes on", needs=_NEEDS)
def refused(kit: CheckMeasurements) -> None:
    mark, _ = kit.begin_long_scan(kit.frames.other)
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
            response = kit.client.ask_directly(kind, subject)
            expect(
                response.code == ControlResponse.NOT_FREE, f"REP_NOT_FREE to {what} while SS_SCANNING",
                answer_in_words(response),
            )  # fmt: skip
    _require_running(kit, mark)
    observed = [one for one in kit.client.observations.since(mark) if one.state is None]
    expect(not observed, "nothing but SS_SCANNING while requests were refused", describe_all(observed))


@check("busy/answered", "during a scan, questions for parameters and supported actions are answered", needs=_NEEDS)
def answered(kit: CheckMeasurements) -> None:
    mark, _ = kit.begin_long_scan(kit.frames.other)
    name = next((one for one, value in kit.support.parameters.items() if value is not None), None)
    asked: list[tuple[ControlRequest, object, str]] = []
    if kit.support.actions[names.STOP_SCAN] is not None:
        asked.append((ControlRequest.ACTION_SUPPORT, names.STOP_SCAN, "asking for stop-scan"))
    if name is not None:
        asked.append((ControlRequest.PARAM, Parameter(name), f"getting {name}"))
    for kind, subject, what in asked:
        response = kit.client.ask(kind, subject)
        expect(response.ok, f"REP_SUCCESS to {what} while SS_SCANNING", answer_in_words(response))
    _require_running(kit, mark)


def _require_running(kit: CheckMeasurements, mark: int) -> None:
    state = kit.client.state
    expect(state is ScopeState.SCANNING, "a scan that goes on", describe_all(kit.client.observations.since(mark)))
