"""Numbers and texts of Asylum's software, as in its panels and its notes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Final

NUMBERS: Final[dict[str, float]] = {
    "ScanSize": 1e-6, "FastScanSize": 1e-6, "SlowScanSize": 1e-6, "ScanRate": 1.0, "XOffset": 0.0, "YOffset": 0.0,
    "PointsLines": 128, "ScanPoints": 128, "ScanLines": 128, "ScanAngle": 0.0, "InvOLS": 6e-8, "SpringConstant": 0.4,
    "AmpInvOLS": 1e-7, "FastRatio": 1.0, "SlowRatio": 1.0, "TopLine": 127, "BottomLine": 0, "ScanSpeed": 2.5e-6,
    "IntegralGain": 10.0, "ProportionalGain": 0.0, "AmplitudeSetpointVolts": 0.7, "AmplitudeSetpointMeters": 7e-8,
    "DriveAmplitude": 0.1, "DriveFrequency": 3.7407e5, "SlowScanEnabled": 1, "DeflectionSetpointVolts": 1.0,
    "MaxScanSize": 9e-5, "ScanStateChanged": 0, "ScanDown": 0, "XLVDTSens": 7.9727e-06, "YLVDTSens": 8.1073e-06,
    "LastScan": 0, "LastScanWithdraw": 0, "BaseSuffix": 0, "SaveImage": 2, "SaveForce": 2, "ParmChange": 0,
    "ScanStatus": 0, "FMapStatus": 0, "DelayUpdate": 0, "TipVoltage": 0.0, "SurfaceVoltage": 0.0, "NapMode": 0,
    "ImagingMode": 1, "ForceSpotNumber": 0, "XScanDirection": 1, "YScanDirection": 1, "Setpoint": 0.0008,
    "ForceDist": 1.6e-7, "Velocity": 1.6e-7,
}  # fmt: skip


class IgorValues:
    """Igor's values by name; case is ignored.

    Args:
        texts: initial values for GS and PS.
    """

    def __init__(self, texts: Mapping[str, str]) -> None:
        self._numbers = {name.lower(): float(value) for name, value in NUMBERS.items()}
        self._texts = {name.lower(): value for name, value in texts.items()}

    def get(self, name: str) -> float:
        """Return a number; NaN for an unknown name."""
        return self._numbers.get(name.lower(), math.nan)

    def put(self, names: str, value: float) -> None:
        """Set one name or a list "A;B;", without range checks and without the side effects of a panel."""
        for name in names.split(";"):
            if name.lower() in self._numbers:
                self._numbers[name.lower()] = value

    def text(self, name: str) -> str:
        return self._texts.get(name.lower(), "")

    def put_text(self, name: str, value: str) -> None:
        if name.lower() in self._texts:
            self._texts[name.lower()] = value

    def size(self) -> tuple[float, float]:
        """Return (fast, slow) in m: ScanSize is the longer side, and the ratios define the shorter side."""
        longer, fast, slow = self.get("ScanSize"), self.get("FastRatio"), self.get("SlowRatio")
        ratio = slow / fast if fast else math.nan
        return (longer / ratio, longer) if ratio > 1.0 else (longer, longer * ratio)

    def settle(self) -> None:
        """Derive the values that the software computes when a scan starts."""
        fast, slow = self.size()
        self.put("FastScanSize", fast)
        self.put("SlowScanSize", slow)
        self.put("ScanSpeed", 2.5 * fast * self.get("ScanRate"))

    def noted(self) -> Iterator[tuple[str, float]]:
        """Return the numbers by their names in a note."""
        return ((name, self._numbers[name.lower()]) for name in NUMBERS)
