"""Functions of Nanonis that an experiment file names: in commands of actions, and as parameters.

Limits can judge a function only if it is known what the function moves or sets. A function is refused if afspm has a
judged way to do the same, if it moves the tip where no limit can follow, or if it changes the units in which limits
count. A function that starts something chosen in Nanonis needs a person's word in the action, `withdrawn`.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

from afspm.basics import InvalidValue
from afspm.driver import CoarseMove, ParameterSpec, Value
from afspm.model import names
from afspm.plugins.nanonis.protocol import Fields, function, function_names, request, types_text

_INTEGERS: Final = "BHIin"
_VALUES: Final = ("H", "I", "i", "f", "d", "S")
_AT_PANEL: Final = "do it at Nanonis, after `afspm pause`"
_BY_SET: Final = "afspm has {}, which limits judge: write set = {{ {} = … }} into the action"

SETS: Final[Mapping[str, Mapping[int, str]]] = {
    "Bias.Set": {0: names.TIP_BIAS_VOLTAGE},
    "Bias.Pulse": {1: names.PULSE_DURATION, 2: names.PULSE_VOLTAGE},
    "BiasSpectr.LimitsSet": {0: names.TIP_BIAS_VOLTAGE, 1: names.TIP_BIAS_VOLTAGE},
    "BiasSpectr.MLSValsSet": {1: names.TIP_BIAS_VOLTAGE, 2: names.TIP_BIAS_VOLTAGE},
    "BiasSpectr.AltZCtrlSet": {1: names.ZCTRL_SETPOINT},
    "BiasSwp.LimitsSet": {0: names.TIP_BIAS_VOLTAGE, 1: names.TIP_BIAS_VOLTAGE},
    "BiasSpectr.TimingSet": {1: names.SPEC_Z_OFFSET},
    "LockIn.ModAmpSet": {1: names.LOCK_IN_AMPLITUDE},
    "ZSpectr.RangeSet": {0: names.SPEC_Z_FROM, 1: names.SPEC_Z_TO},
    "KelvinCtrl.BiasLimitsSet": {0: names.TIP_BIAS_VOLTAGE, 1: names.TIP_BIAS_VOLTAGE},
    "MProbeBias.Set": {1: names.TIP_BIAS_VOLTAGE},
    "MProbeBias.Pulse": {2: names.PULSE_DURATION, 3: names.PULSE_VOLTAGE},
    "Scan.BufferSet": {1: names.SCAN_RESOLUTION_X, 2: names.SCAN_RESOLUTION_Y},
    "ZCtrl.SetpntSet": {0: names.ZCTRL_SETPOINT},
}
"""The parameters that functions set, by the place of the argument: a number, or a list of numbers."""

_REFUSED: Final[Mapping[str, str]] = {
    r"AutoApproach\.OnOffSet [^0]": f"it brings the tip to the sample: use {names.APPROACH}, after which it is judged",
    r"ZCtrl\.OnOffSet": _BY_SET.format(names.FEEDBACK_ON, names.FEEDBACK_ON) + ", or use x-engage",
    # it moves away from the sample, but a running approach or scan would bring the tip back
    r"ZCtrl\.Withdraw ": "use x-retract, which first stops what would bring the tip back",
    r"ZCtrl\.(ActiveCtrl|Limits|LimitsEnabled)Set|SafeTip\.(OnOff|Props)Set": (
        f"afspm's guards of the tip depend on it: {_AT_PANEL}"
    ),
    r"(MProbe)?Bias\.(Range|Calibr)Set|(MProbe)?Current\.CalibrSet|Piezo\.(Range|Sens|XYZLimits|Hyst\w+)Set": (
        f"limits count in the units that it changes: {_AT_PANEL}"
    ),
    r"MProbe(ZCtrl\.\w+(?<!Get) |ZCtrl\.\w+(?<!Get)$|Scanner\.\w+(?<!Get) )": (
        f"it moves another probe, which no limit bounds: {_AT_PANEL}"
    ),
    r"Scan\.FrameSet": _BY_SET.format("the frame", f"{names.SCAN_TOP_LEFT_X} = …, {names.SCAN_SIZE_X}"),
    r"Scan\.SpeedSet": _BY_SET.format(names.SCAN_SPEED, names.SCAN_SPEED),
    r"FolMe\.SpeedSet": _BY_SET.format(names.MOVE_SPEED, names.MOVE_SPEED),
    r"FolMe\.XYPosSet": _BY_SET.format("the place of the tip", f"{names.PROBE_POS_X} = …, {names.PROBE_POS_Y}"),
    r"ZCtrl\.GainSet": _BY_SET.format("the gains", f"{names.ZCTRL_PGAIN} = …, {names.ZCTRL_IGAIN}"),
    r"Piezo\.TiltSet": _BY_SET.format("the slopes", f"{names.SAMPLE_SLOPE_X} = …, {names.SAMPLE_SLOPE_Y}"),
    r"Piezo\.DriftCompSet": _BY_SET.format("drift rates", f"{names.DRIFT_RATE_X} = …, {names.DRIFT_RATE_Y}"),
}
"""Functions that neither an action nor a parameter may call, with the reason and the remedy."""

_REFUSED_ACTIONS: Final[Mapping[str, str]] = {
    r"ZCtrl\.(ZPosSet|TipLiftSet)|ZSpectr\.RangeSet": (
        "it moves z, which no limit bounds: declare a parameter for it, with a range, and write set = { … }"
    ),
    r"ZCtrl\.Home": f"it moves z, also towards the sample: {_AT_PANEL}",
    r"BiasSpectr\.TimingSet \S+ (?!0\.0|nan)|BiasSpectr\.PropsSet (\S+ ){4}(?!0\.0|nan)": (
        "its z offset moves the tip, which no limit bounds: write 0"
    ),
    r"(MProbe)?Bias\.Pulse .* [^2]$": "limits can't judge a relative pulse: write 2, absolute, as the last argument",
    r"Motor\.StartClosedLoop": "it may go towards the sample: use Motor.StartMove",
    r"Motor\.StartMove .* 0$": "Nanonis does not show that its motor moves: write 1, wait, as the last argument",
    r"TipShaper\.Start": f"use {names.CRASH}, whose depth limits judge",
    r"Scan\.Action 0": f"use {names.START_SCAN}, which limits judge",
    r"(Bias|Z)Spectr\.Start": f"use {names.START_SPEC}, which limits judge",
    r"FolMe\.PSOnOffSet [^0]": f"each move of the tip would begin a curve: use {names.START_SPEC}, which limits judge",
    r"Util\.Quit": f"it ends Nanonis: {_AT_PANEL}",
}
"""Functions that an action may not call either, by the function and its arguments."""

_CHOSEN_IN_NANONIS: Final = (
    r"(BiasSwp|GenSwp|HSSwp|FunGen[12]Ch)\.Start|Script\.(Run|LUTDeploy)|Util\.SettingsLoad|MPass\.Activate|Pattern\.ExpStart"
    r"|CPDComp\.Open|KelvinCtrl\.CtrlOnOffSet [^0]"
)


@dataclass(frozen=True)
class FunctionCall:
    """A function with its arguments."""

    name: str
    arguments: tuple[object, ...]

    @classmethod
    def of(cls, command: str) -> FunctionCall:
        """Return the call of a command, "Pattern.CloudSet 1 2 [1e-9,2e-9] [0,0]".

        Raises:
            InvalidValue: there is no such function, or it takes other arguments.
        """
        try:
            name, *words = shlex.split(command) or [""]
        except ValueError as error:
            raise InvalidValue(f"{command!r} can't be read: {error}") from error
        call = cls(name, _arguments(name, function(name).arguments, words))
        request(name, call.arguments)  # raises if a number does not fit its type
        return call


_DIRECTIONS: Final = ("X+", "X-", "Y+", "Y-", "Z+", "Z-")


def move_of_motor(action: Mapping[str, object]) -> CoarseMove | None:
    """Return the move of the coarse motor by an action's command; None for another command."""
    try:
        call = FunctionCall.of(str(action.get("command", "")))
    except InvalidValue:  # reported with the action
        return None
    if not call.name.startswith("Motor.Start"):
        return None
    if call.name != "Motor.StartMove":
        return CoarseMove()
    direction, steps, *_ = call.arguments
    named = _DIRECTIONS[direction] if isinstance(direction, int) and direction < len(_DIRECTIONS) else ""
    return CoarseMove(named, not named.startswith("Z") if named else None, steps if isinstance(steps, int) else None)


def values_commanded(action: Mapping[str, object]) -> list[tuple[str, Value]]:
    """Return the parameters that the command of an action sets, with values in Nanonis' units.

    Raises:
        InvalidValue: there is no such function, it takes other arguments, or no action may call it.
    """
    call = FunctionCall.of(str(action["command"]))
    text = " ".join(map(str, (call.name, *call.arguments)))
    _refuse(text, {**_REFUSED, **_REFUSED_ACTIONS})
    if re.match(_CHOSEN_IN_NANONIS, text) and "withdrawn" not in action:
        raise InvalidValue(
            f"{call.name} starts something chosen in Nanonis, which limits can't judge",
            hint="write withdrawn = true into the action, or withdrawn = false if it is safe with a tip at the sample",
        )
    given = [(name, call.arguments[place]) for place, name in SETS.get(call.name, {}).items()]
    return [(name, one) for name, value in given for one in (value if isinstance(value, tuple) else (value,))]


def _refuse(text: str, among: Mapping[str, str]) -> None:
    reason = next((reason for pattern, reason in among.items() if re.match(pattern, text)), None)
    if reason is not None:
        raise InvalidValue(f"{text.split()[0]} can't be used in an experiment file: {reason}")


def _arguments(name: str, fields: Fields, words: Sequence[str]) -> tuple[object, ...]:
    try:
        return tuple(_argument(field.code, word) for field, word in zip(fields, words, strict=True))
    except ValueError as error:
        raise InvalidValue(f"{name} takes {types_text(fields)}, not {' '.join(words) or 'none'}") from error


def _argument(code: str, word: str) -> object:
    if code in _INTEGERS:
        return int(word)
    if code in "fd":
        return float(word)
    if code == "S":
        return word
    if (code == "A" or code[0] in "[*") and word[:1] + word[-1:] == "[]":
        item = "S" if code == "A" else code[1]
        return tuple(_argument(item, one.strip()) for one in word[1:-1].split(",") if one.strip())
    raise ValueError(code)


@dataclass(frozen=True)
class ValueFunctions:
    """The functions that read and set a parameter.

    Attributes:
        setter: empty if the value can only be read.
        keys: first arguments of both functions, such as the number of a modulator.
        place: place of the value among the results, and among the further arguments.
    """

    getter: str
    setter: str
    keys: tuple[object, ...]
    place: int

    @classmethod
    @cache
    def of(cls, vendor: str) -> ValueFunctions:
        """Return the functions by a vendor's name: "Bias.", "LockIn.ModAmp 1", "ZSpectr.Range #2" (the second value).

        Raises:
            InvalidValue: there is no such function, it takes other keys, or has no such value.
        """
        module, *words = vendor.split() or [""]
        number = words.pop()[1:] if words and words[-1].startswith("#") else "1"
        getter = function(f"{module}Get")
        keys, found = _arguments(getter.name, getter.arguments, words), getter.layouts[0]
        if not number.isdecimal() or not 1 <= int(number) <= len(found):
            raise InvalidValue(f"{getter.name} returns {types_text(found)}, without a value #{number}")
        place = int(number) - 1
        if found[place].code not in _VALUES:
            raise InvalidValue(f"{getter.name} returns {found[place].text} as value #{number}, which is no parameter")
        setter = f"{module}Set"
        is_pair = setter in function_names() and _fit(function(setter).arguments, getter.arguments, found)
        return cls(getter.name, setter if is_pair else "", keys, place)

    @property
    def is_one_of_several(self) -> bool:
        return len(function(self.getter).layouts[0]) > 1

    def arguments(self, value: Value, present: Sequence[object]) -> list[object]:
        """Return the arguments that set a value.

        Args:
            present: the results of the getter: the other values stay as they are.
        """
        marks = [field.mark for field in function(self.setter).arguments[len(self.keys) :]]
        kept = [_unchanged(mark, present[place]) for place, mark in enumerate(marks) if place != self.place]
        kept.insert(self.place, _marked(marks[self.place], value))
        return [*self.keys, *kept]


def _fit(arguments: Fields, keys: Fields, values: Fields) -> bool:
    # values of some releases alone would be at other places
    return len(arguments) == len(keys) + len(values) and not any(one.since for one in values)


def _marked(mark: str, value: Value) -> Value:
    if mark == "?":
        return 1 if value else 2
    return int(value) + 1 if mark == "-" else value


def _unchanged(mark: str, present: object) -> object:
    if not mark:
        return present
    return int(mark[1:]) if mark[0] == "=" else 0


def check_row(row: ParameterSpec) -> None:
    """Require that a row of the experiment file names functions of Nanonis, and a quantity without limits of its own.

    Raises:
        InvalidValue: Nanonis has no such functions, or a parameter of afspm sets the same quantity.
    """
    functions = ValueFunctions.of(row.vendor)
    code = function(functions.getter).layouts[0][functions.place].code
    types = ("text",) if code == "S" else ("int", "bool") if code in _INTEGERS else ("float", "int")
    if row.type not in types:
        raise InvalidValue(
            f"the value of {functions.getter} is not of the type {row.type!r}: write type = {types[0]!r}"
        )
    if row.read_only:
        return
    if not functions.setter:
        raise InvalidValue(f"afspm can read {row.vendor}, and not set it: write read_only = true")
    only_actions = {_CHOSEN_IN_NANONIS: "use it in an action, with your word on the tip, `withdrawn`"}
    _refuse(" ".join(map(str, (functions.setter, *functions.keys, math.inf))), {**_REFUSED, **only_actions})
    same = SETS.get(functions.setter, {}).get(len(functions.keys) + functions.place, row.name)
    if same != row.name:
        raise InvalidValue(f"{functions.setter} sets {same}: use that parameter, whose limits count")
