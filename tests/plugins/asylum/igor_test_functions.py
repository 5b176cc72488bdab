"""Igor functions for the reference calls of ZeroMQ-XOP."""

from __future__ import annotations

import math
from typing import Any

from tests.plugins.asylum.asylum_bench import Emulated

from afspm.plugins.asylum.emulator.wire import CallFailed, IgorFunction, wave


def _aborts(*_: object) -> float:
    raise CallFailed(107, "the history")


def _nothing(*_: object) -> float:
    return math.nan


_FUNCTIONS: dict[str, IgorFunction] = {
    "TestFunctionNoArgs": IgorFunction(_nothing),
    "TestFunction1Arg": IgorFunction(lambda x: x, "v"),
    "TestFunction2Args": IgorFunction(lambda a, b: a + b, "vv"),
    "TestFunctionStrVarStr": IgorFunction(lambda a, b, c: f"{a}_{b:g}_{c}", "svs", "s"),
    "TestFunctionInvalidSig1": IgorFunction(_nothing, "w"),
    "TestFunctionInvalidSig3": IgorFunction(_nothing, "c"),
    "TestFunctionWithIntParam2": IgorFunction(_nothing, "i"),
    "TestFunctionInvalidRet2": IgorFunction(_nothing, "", "c"),
    "TestFunctionOptionalStructArg": IgorFunction(_nothing),
    "TestFunctionReturnNullWave": IgorFunction(lambda: None, "", "w"),
    "TestFunctionReturnFreeWave": IgorFunction(lambda: wave([1.0, 2.5, math.nan]), "", "w"),
    "TestFunctionReturnDFWave": IgorFunction(lambda: wave([1.0], note="a note"), "", "w"),
    "TestFunctionAbort1": IgorFunction(_aborts),
    "TestFunctionPassByRef2": IgorFunction(lambda _: (math.nan, ("hi there",)), "S"),
    "TestFunctionPassByRef4": IgorFunction(_aborts, "VS"),
    "TestFunctionPassByRef6": IgorFunction(_nothing),
    "TestFunctionPassByRef7": IgorFunction(_nothing, "W"),
    "TestFunctionReturnDFR": IgorFunction(lambda: "root:", "", "d"),
    "TestFunctionReturnDanglingDFR": IgorFunction(lambda: "null", "", "d"),
    "TestFunctionWithDFRParam2": IgorFunction(lambda folder: folder, "d", "d"),
    "TestFunctionMultipleReturnValuesValid1": IgorFunction(lambda: (123.0, "Hi there!", math.nan), "", "vsv"),
    "TestFunctionMultipleReturnValuesValid3": IgorFunction(lambda: ("root:Packages:", 1.0), "", "dv"),
    "TestFunctionMultipleReturnValuesValid5": IgorFunction(lambda: (0.0, ""), "", "vs"),
    "TestFunctionOneResultListed": IgorFunction(lambda: (123.0,), "", "v", listed=True),
    "TestFunctionVariableAndWave": IgorFunction(_nothing, "vw"),
    "TestFunctionWaveForComplex": IgorFunction(_nothing, "w", "c"),
    "TestFunctionBreaks": IgorFunction(lambda: 1 / 0),
    "TestNotUtf8": IgorFunction(lambda: "29.5 \udcb0C", "", "s"),
}


class WithTestFunctions(Emulated):
    """An emulator with these functions."""

    def functions(self) -> dict[str, Any]:
        return super().functions() | {name.lower(): function for name, function in _FUNCTIONS.items()}
