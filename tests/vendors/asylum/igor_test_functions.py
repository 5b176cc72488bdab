"""The functions that the reference calls of ZeroMQ-XOP are about, as Igor would have them."""

from __future__ import annotations

import math
from typing import Any

from asylum_bench import Emulated

from afspm.emulators.asylum.wire import Failed, Function, wave


def _aborts(*_: object) -> float:
    raise Failed(107, "the history")


def _nothing(*_: object) -> float:
    return math.nan


_FUNCTIONS: dict[str, Function] = {
    "TestFunctionNoArgs": Function(_nothing),
    "TestFunction1Arg": Function(lambda x: x, "v"),
    "TestFunction2Args": Function(lambda a, b: a + b, "vv"),
    "TestFunctionStrVarStr": Function(lambda a, b, c: f"{a}_{b:g}_{c}", "svs", "s"),
    "TestFunctionInvalidSig1": Function(_nothing, "w"),
    "TestFunctionInvalidSig3": Function(_nothing, "c"),
    "TestFunctionWithIntParam2": Function(_nothing, "i"),
    "TestFunctionInvalidRet2": Function(_nothing, "", "c"),
    "TestFunctionOptionalStructArg": Function(_nothing),
    "TestFunctionReturnNullWave": Function(lambda: None, "", "w"),
    "TestFunctionReturnFreeWave": Function(lambda: wave([1.0, 2.5, math.nan]), "", "w"),
    "TestFunctionReturnDFWave": Function(lambda: wave([1.0], note="a note"), "", "w"),
    "TestFunctionAbort1": Function(_aborts),
    "TestFunctionPassByRef2": Function(lambda _: (math.nan, ("hi there",)), "S"),
    "TestFunctionPassByRef4": Function(_aborts, "VS"),
    "TestFunctionPassByRef6": Function(_nothing),
    "TestFunctionPassByRef7": Function(_nothing, "W"),
    "TestFunctionReturnDFR": Function(lambda: "root:", "", "d"),
    "TestFunctionReturnDanglingDFR": Function(lambda: "null", "", "d"),
    "TestFunctionWithDFRParam2": Function(lambda folder: folder, "d", "d"),
    "TestFunctionMultipleReturnValuesValid1": Function(lambda: (123.0, "Hi there!", math.nan), "", "vsv"),
    "TestFunctionMultipleReturnValuesValid3": Function(lambda: ("root:Packages:", 1.0), "", "dv"),
    "TestFunctionMultipleReturnValuesValid5": Function(lambda: (0.0, ""), "", "vs"),
    "TestFunctionOneResultListed": Function(lambda: (123.0,), "", "v", listed=True),
    "TestFunctionVariableAndWave": Function(_nothing, "vw"),
    "TestFunctionWaveForComplex": Function(_nothing, "w", "c"),
    "TestFunctionBreaks": Function(lambda: 1 / 0),
    "TestNotUtf8": Function(lambda: "29.5 \udcb0C", "", "s"),
}


class WithTestFunctions(Emulated):
    """An emulator that has them."""

    def functions(self) -> dict[str, Any]:
        return super().functions() | {name.lower(): function for name, function in _FUNCTIONS.items()}
