"""What has to be refused: unknown names, values that can't be, places out of reach."""

from __future__ import annotations

import math

from afspm.model import ControlRequest, ControlResponse, Feedback, Parameter, ProbePosition, ScanParameters, names
from afspm.testing.translators.bench import answer_in_words
from afspm.testing.translators.checks.parameters import require_param_error
from afspm.testing.translators.registry import check
from afspm.testing.translators.story import told
from afspm.testing.translators.taking import Taking
from afspm.testing.translators.verdicts import expect
from afspm.wire import messages

_UNKNOWN = "no-such-thing"


@check("refused/unknown-parameter", "a parameter that there is not: REP_PARAM_NOT_SUPPORTED")
def unknown_parameter(kit: Taking) -> None:
    for parameter in (Parameter(_UNKNOWN), Parameter(_UNKNOWN, "1", "m")):
        _require(kit, ControlRequest.PARAM, parameter, ControlResponse.PARAM_NOT_SUPPORTED, f"REQ_PARAM {_UNKNOWN}")


@check("refused/unknown-action", "an action that there is not: REP_ACTION_NOT_SUPPORTED")
def unknown_action(kit: Taking) -> None:
    can_be_asked = None not in kit.support.actions.values()
    for kind in (ControlRequest.ACTION, *([ControlRequest.ACTION_SUPPORT] if can_be_asked else [])):
        _require(kit, kind, _UNKNOWN, ControlResponse.ACTION_NOT_SUPPORTED, f"REQ_{kind.name} {_UNKNOWN}")


def _require(kit: Taking, kind: ControlRequest, subject: object, code: ControlResponse, what: str) -> None:
    response = kit.bench.ask_directly(kind, subject)
    expect(response.code == code, f"REP_{code.name} to {what}", answer_in_words(response))


@check("refused/read-only", "a parameter that can only be read is not set", needs=(names.CONTROLLER,))
def read_only(kit: Taking) -> None:
    require_param_error(kit, names.CONTROLLER, "mine", None, kit.bench.get(names.CONTROLLER))


@check("refused/too-large", "a frame of a kilometre, or of none, is refused, not clamped", needs=(names.SCAN_SIZE_X,))
def too_large(kit: Taking) -> None:
    kit.bench.come_to_rest()
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
            before = kit.bench.get(name)
            unit = None if "resolution" in name else "m"
            for value in values:
                require_param_error(kit, name, value, unit, before)


@check("refused/whole-frame", "a frame that can't be set as a whole changes nothing", needs=(names.SCAN_SIZE_X,))
def whole_frame(kit: Taking) -> None:
    message = messages.ScanParameters2d()
    message.spatial.length_units = "m"
    message.spatial.roi.size.x = 0.9 * kit.frames.whole.size_m[0]
    message.spatial.roi.top_left.x = 1000.0
    _require_unchanged(kit, ControlRequest.SET_SCAN_PARAMS, message, ScanParameters, "a frame a kilometre away")


@check("refused/nan", "NaN in a frame, a position or the feedback is refused, and changes nothing")
def nan(kit: Taking) -> None:
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
def unit_of_frame(kit: Taking) -> None:
    message = messages.ScanParameters2d()
    message.spatial.length_units = "kg"
    message.spatial.roi.size.x = 0.9 * kit.frames.whole.size_m[0]
    _require_unchanged(kit, ControlRequest.SET_SCAN_PARAMS, message, ScanParameters, "a frame in kg")


def _require_unchanged(kit: Taking, kind: ControlRequest, subject: object, published: type, what: str) -> None:
    bench = kit.bench
    bench.come_to_rest()
    before, mark = bench.story.newest(published), bench.story.mark()
    response = bench.ask_directly(kind, subject)
    expect(response.code == ControlResponse.PARAM_ERROR, f"REP_PARAM_ERROR to {what}", answer_in_words(response))
    heard = bench.settled(mark)
    expect(bench.story.newest(published) == before, f"nothing changed by {what}", told(heard))
