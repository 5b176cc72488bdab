"""Igor functions that a client can call: Asylum's own, and those of included procedures."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from afspm.plugins.asylum.emulator.controller import AsylumController, AsylumSettings
from afspm.plugins.asylum.emulator.wire import CallFailed, IgorFunction

ABORTED: Final = 107
_NOTHING: Final = math.nan
"""Result of an Igor function without a return statement."""


class DialogOpen(Exception):
    """A modal dialog that blocks Igor; after OK the function returns `result`."""

    def __init__(self, text: str, result: float) -> None:
        super().__init__(text)
        self.result = result


class AsylumFunctions:
    """Asylum's functions, and those of the procedures that the settings include."""

    def __init__(self, controller: AsylumController, now_s: Callable[[], float], settings: AsylumSettings) -> None:
        self._controller = controller
        self._now_s = now_s
        self._settings = settings

    def table(self) -> dict[str, IgorFunction]:
        """Return the functions by lower-case name, since Igor ignores case."""
        values = self._controller.values
        table = {
            "GV": IgorFunction(self._get, "s"),
            "PV": IgorFunction(self._put, "sv"),
            "GS": IgorFunction(values.text, "s", "s"),
            "PS": IgorFunction(self._put_text, "ss"),
            "DoScanFunc": IgorFunction(self._do_scan, "s"),
            "DoForceFunc": IgorFunction(self._do_force, "s"),
            "GoToSpot": IgorFunction(self._go_to_spot),
            "SimpleEngageMe": IgorFunction(self._engage, "s"),
            "ARCheckSuffix": IgorFunction(self._check_suffix),
        }
        if self._settings.has_status:
            table["ARGetStatus"] = IgorFunction(self._status)
        if self._settings.procedures != "none":
            table |= self._spots()
        if self._settings.procedures == "afspm":
            table |= self._afspm()
        return {name.lower(): function for name, function in table.items()}

    def _spots(self) -> dict[str, IgorFunction]:
        values = self._controller.values
        return {
            "InitProbePos": IgorFunction(self._init_spots),
            "SetProbePosX": IgorFunction(lambda x: self._set_spot(0, x), "v"),
            "SetProbePosY": IgorFunction(lambda y: self._set_spot(1, y), "v"),
            "GetProbePosX": IgorFunction(lambda: self._spot()[0]),
            "GetProbePosY": IgorFunction(lambda: self._spot()[1]),
            "GetBaseName": IgorFunction(lambda: values.text("BaseName"), "", "s"),
            "SetBaseName": IgorFunction(lambda name: self._put_text("BaseName", name), "s"),
        }

    def _afspm(self) -> dict[str, IgorFunction]:
        return {
            "AfspmLook": IgorFunction(self._look, "s", "s"),
            "AfspmController": IgorFunction(lambda: "Igor Pro 6.37, SIMULATED", "", "s"),
            "AfspmFeedback": IgorFunction(self._feedback, "v"),
            "AfspmFeedbackOn": IgorFunction(self._feedback_on),
        }

    # --- values ---

    def _get(self, name: str) -> float:
        value = self._controller.values.get(name)
        return math.nan if self._controller.faults.strikes("nan", self._now_s()) else value

    def _put(self, names: str, value: float) -> float:
        self._controller.put(names, value, self._now_s())
        return _NOTHING

    def _put_text(self, name: str, value: str) -> float:
        self._controller.values.put_text(name, value)
        return 0.0

    def _check_suffix(self) -> float:
        self._controller.check_suffix()
        return 0.0

    def _look(self, names: str) -> str:
        status = self._status() if self._settings.has_status else math.nan
        found = [status, *(self._get(name) for name in names.split(";") if name)]
        return "".join(f"{value:.15g};" for value in found)

    def _status(self) -> float:
        return float(self._controller.status(self._now_s()))

    # --- actions ---

    def _do_scan(self, button: str) -> float:
        # Asylum's own code cuts the command out of the name of the pressed button, at the last "_" and at "Button".
        name = button[: button.rfind("_")] if "_" in button else button
        name = name[: name.rfind("Button")] if "Button" in name else name
        now_s = self._now_s()
        if name in ("DoScan", "UpScan", "DownScan"):
            self._controller.scan(now_s, {"UpScan": False, "DownScan": True}.get(name))
        elif name in ("StopScan", "StopEngage"):
            self._controller.stop(now_s)
        else:
            raise DialogOpen(f"Something called DoScanFunc with an invalid CtrlName {button!r}", 1.0)
        return 0.0

    def _do_force(self, button: str) -> float:
        name = button.partition("Force")[0]
        # the real function has no return after a start, and returns 0 for a refusal: the reverse of the others
        if name == "Single":
            return _NOTHING if self._controller.curve(self._now_s()) else 0.0
        if name == "Go":
            return self._go_to_spot()
        if name in ("Reset", "Stop"):
            if name == "Reset":
                self._controller.stop_curve(self._now_s())
            return 0.0
        return 1.0

    def _go_to_spot(self) -> float:
        if not self._settings.image_open:
            raise DialogOpen("there is no image with spots", 0.0)
        self._controller.go_to_spot(self._now_s())
        return 0.0

    def _engage(self, _: str) -> float:
        self._controller.engage(self._now_s())
        return 0.0

    def _feedback(self, on: float) -> float:
        if on:
            return self._engage("")
        self._controller.feedback_off(self._now_s())
        return 0.0

    def _feedback_on(self) -> float:
        return float(self._controller.rig.engaged and self._controller.rig.feedback_reads(self._now_s()))

    # --- spots ---

    def _init_spots(self) -> float:
        if len(self._controller.spots_m) < 2:
            self._controller.spots_m.append(self._controller.spots_m[0])
        self._controller.values.put("ForceSpotNumber", 1)
        return 0.0

    def _spot(self) -> tuple[float, float]:
        if len(self._controller.spots_m) < 2:
            raise CallFailed(ABORTED, "Index out of range for wave SpotX.")
        return self._controller.spots_m[1]

    def _set_spot(self, axis: int, value: float) -> float:
        x, y = self._spot()
        self._controller.spots_m[1] = (value, y) if axis == 0 else (x, value)
        return 0.0
