"""Messages, drawn: the bytes of a packet, a request and a response, and the two paths that they take."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from sheet import CONTROL, DATA, GREY, INK, QUIET, Sheet

from afspm.model import ControlResponse

GOLDEN: Final = Path(__file__).resolve().parents[1] / "proto" / "golden.json"
MONOSPACE: Final = 7.0  # the width of a digit of 12 px, with some room


def two_paths() -> str:
    """Packets up from the microscope to all subscribers; requests down from one component at a time."""
    sheet = Sheet()
    rows = {"components": 60.0, "Microscope Scheduler": 160.0, "Microscope Translator": 250.0, "controller": 330.0}
    sheet.note((185, 20), "Packets: publish and subscribe", bold=True, fill=DATA)
    sheet.note((555, 20), "Requests: ask and answer", bold=True, fill=CONTROL)
    for left, stroke, names in (
        (185.0, DATA, ("Visualizer", "Tip classifier", "Recorder")),
        (555.0, CONTROL, ("Scan series", "Tip corrector", "Dashboard")),
    ):
        for number, name in enumerate(names):
            x = left + (number - 1) * 115.0
            sheet.box((x, rows["components"]), (104, 32), "component", name)
            ends = ((left + (number - 1) * 60.0, 138.0), (x, 78.0))
            sheet.arrow(*(ends if stroke == DATA else ends[::-1]), stroke=stroke, both=stroke == CONTROL)
        what = "cache for late joiners" if stroke == DATA else "one in control; limits"
        sheet.box((left, rows["Microscope Scheduler"]), (220, 44), "scheduler", "Microscope Scheduler", what)
        sheet.box((left, rows["Microscope Translator"]), (220, 34), "translator", "Microscope Translator")
        sheet.box((left, rows["controller"]), (220, 32), "controller", "the maker's controller")
        below = [((left, 232.0), (left, 183.0)), ((left, 313.0), (left, 268.0))]
        for ends in below:
            sheet.arrow(*(ends if stroke == DATA else ends[::-1]), stroke=stroke, both=stroke == CONTROL)
    for y, text in ((208.0, "Scan2d, ScopeStateMsg, …"), (292.0, "files, signals")):
        sheet.note((196, y + 3), text, anchor="start", size=11, fill=DATA)
    for y, text in ((208.0, "start-scan, a parameter, …"), (292.0, "its own commands")):
        sheet.note((566, y + 3), text, anchor="start", size=11, fill=CONTROL)
    sheet.note((185, 368), "Each component gets the messages that it subscribes to.", size=11)
    sheet.note((555, 368), "Each request gets one answer: done, or refused and why.", size=11)
    return sheet.document(740, 382, "Two paths: packets up, requests down")


def message_bytes() -> str:
    """The frames of a packet, a request and its response, and the fields in the bytes of a message."""
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    packet = next(one for one in golden["published"] if one["envelope"] == "Scan2d_2000.0_Height Retrace")
    request = next(one for one in golden["requests"] if one["request"] == "REQ_SET_ZCTRL_PARAMS")
    response = golden["our_responses"][0]
    sheet = Sheet()
    sheet.note((18, 22), "A published packet", anchor="start", bold=True)
    envelope, scan, time = packet["frames"]
    _frame(sheet, 36, "1 envelope", f"“{bytes.fromhex(envelope).decode()}”")
    _frame(sheet, 62, "2 message", f"{_shown(scan, 16)} … · Scan2d, {len(scan) // 2} bytes")
    _frame(sheet, 88, "3 time", f"{_shown(time, 20)} · Timestamp")
    sheet.note((18, 144), "A request, and the response when it could not be sent on", anchor="start", bold=True)
    number, parameters = request["frames"]
    identity = response["frames"][3]
    _frame(sheet, 158, "1 number", f"{number} · {request['request']}")
    _frame(sheet, 184, "2 object", f"{_shown(parameters, 20)} · ZCtrlParameters")
    _frame(sheet, 210, "3 id", f"“{bytes.fromhex(identity).decode()}” · the same when it is repeated")
    name = ControlResponse(response["response"]).name
    code, _, reason, _, detail = response["frames"]
    answer = (
        ("1 number", f"{code} · REP_{name}"),
        ("2 object", "empty"),
        ("3 reason", f"“{bytes.fromhex(reason).decode()}” · text for a person"),
        ("4 id", "of the request"),
        ("5 detail", f"{detail} · not sent, may be repeated"),
    )
    for row, (name, text) in enumerate(answer):
        _frame(sheet, 244 + row * 26, name, text, stroke=CONTROL)
    sheet.note((18, 404), "The bytes of that object: fields, one after the other", anchor="start", bold=True)
    _fields(
        sheet,
        418,
        bytes.fromhex(parameters),
        ("feedbackOn", "proportionalGain", "integralGain", "setPoint"),
        request["object"],
    )
    note = "A tag is (number of the field) × 8 + type. A field that was not set is not there."
    sheet.note((18, 506), note, anchor="start", size=11, fill=QUIET)
    return sheet.document(740, 520, "The bytes of a packet, a request and a response")


def _frame(sheet: Sheet, y: float, name: str, text: str, *, stroke: str = DATA) -> None:
    sheet.svg.box(18, y, 704, 22, fill="#e7f1f8" if stroke == DATA else "#fdf0e3", stroke=stroke, corner=3)
    sheet.note((28, y + 15), name, anchor="start", bold=True)
    sheet.note((120, y + 15), text, anchor="start")


def _fields(sheet: Sheet, y: float, data: bytes, names: Sequence[str], values: dict[str, Any]) -> None:
    """Draw each field of a message: its tag, its value in bytes, and both in words."""
    x, at = 18.0, 0
    for name in names:
        tag = data[at]
        long = {0: 1, 5: 4}[tag & 7]
        value = data[at + 1 : at + 1 + long]
        at += 1 + long
        for part, fill, stroke in ((bytes([tag]), "#eeeeee", GREY), (value, "#e7f1f8", DATA)):
            wide = len(part) * 21.0 + 10
            sheet.svg.box(x, y, wide, 24, fill=fill, stroke=stroke, corner=3)
            sheet.note((x + wide / 2, y + 16), part.hex(" "))
            x += wide + 2
        begin = x - (long * 21.0 + 12) - 33
        for row, text in enumerate((f"field {tag >> 3}", name, f"= {values[name]}".replace("True", "true"))):
            sheet.note(
                (begin, y + 40 + row * 14), text, anchor="start", size=11, fill=INK if row else QUIET, bold=row == 1
            )
        x = max(x + 14, begin + 24 + len(name) * MONOSPACE)


def _shown(hexadecimal: str, most: int) -> str:
    return bytes.fromhex(hexadecimal)[:most].hex(" ")
