"""MyScope: translates afspm's requests to a microscope into commands of its controller.

Replace each use of `PretendController`, method by method, by commands to the real controller.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from afspm.basics import Clock, FileError
from afspm.driver import Driver, Value, action
from afspm.model import Region, Scan, ScopeState, ScopeStatus, Spectrum, names


class MyScope(Driver):
    """The driver of the microscope.

    Args:
        address: address of the controller.
        settings: settings that all drivers take.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    channel_roles: ClassVar = {"height": ("Height",)}  # your names of the channels, for components of any maker
    simulated = True  # remove this line for a real microscope: its time is real, and its tip can break

    def __init__(self, *, address: str = "127.0.0.1:5000", **settings: Any) -> None:
        super().__init__(**settings)
        self.address = address

    def connect(self) -> None:
        """Connect to the controller; called again after each loss (a ConnectionError of any method)."""
        self.controller = PretendController(self.clock, self.run_dir / "scans")

    def status(self) -> ScopeStatus:
        """Return the present activity of the controller."""
        return ScopeStatus(ScopeState.SCANNING if self.controller.is_scanning() else ScopeState.FREE)

    def get(self, vendor: str) -> Value:
        """Return a value by the vendor's name, in the vendor's unit, as in parameters.toml."""
        return self.controller.values[vendor]

    def set(self, values: Mapping[str, Value]) -> None:
        """Set values. afspm has checked them, and reads them back afterwards."""
        self.controller.values.update(values)

    def results(self) -> Sequence[str]:
        """Return all finished files, oldest first."""
        return sorted(str(file) for file in self.controller.folder.glob("*.npz"))

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        """Return all channels of a file, rows ascending with y, columns with x. Raises FileError: incomplete."""
        try:
            with np.load(result) as file:
                x_m, y_m, width_m, height_m = file["frame_m"]
                region = Region.from_top_left((x_m, y_m), (width_m, height_m), float(file["angle_rad"]))
                return [Scan(region, "Height", "m", file["height_m"], int(file["time_ns"]), result)]
        except (OSError, ValueError, KeyError) as error:
            raise FileError(f"is incomplete: {error}", where=result) from error

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        """Start a scan; `status` reports its progress."""
        self.controller.start()

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        """Interrupt the scan, which must not produce a file."""
        self.controller.stop()


class PretendController:
    """A stand-in for your controller, which stores values, scans at its speed, and saves a file."""

    def __init__(self, clock: Clock, folder: Path) -> None:
        self.folder = folder
        self.values: dict[str, Value] = {
            "X": -500.0, "Y": -500.0, "Width": 1000.0, "Height": 1000.0, "Angle": 0.0, "Columns": 64, "Rows": 64,
            "Speed": 10.0, "P": 1.0, "I": 100.0, "Setpoint": 0.5, "Loop": True, "TipX": 0.0, "TipY": 0.0, "Bias": 100.0,
            "Version": "a controller that only pretends",
        }  # fmt: skip
        self._clock = clock
        self._ends_s: float | None = None
        folder.mkdir(parents=True, exist_ok=True)

    def start(self) -> None:
        there_and_back_nm = 2.0 * float(self.values["Width"]) * int(self.values["Rows"])
        self._ends_s = self._clock.now_s() + there_and_back_nm / (1000.0 * float(self.values["Speed"]))

    def stop(self) -> None:
        self._ends_s = None

    def is_scanning(self) -> bool:
        if self._ends_s is not None and self._clock.now_s() >= self._ends_s:
            self._save(self._ends_s)
            self._ends_s = None
        return self._ends_s is not None

    def _save(self, ended_s: float) -> None:
        x, y, width, height = (float(self.values[name]) * 1e-9 for name in ("X", "Y", "Width", "Height"))
        angle_rad = np.radians(float(self.values["Angle"]))
        region = Region.from_top_left((x, y), (width, height), float(angle_rad))
        x_m, y_m = region.pixels_m((int(self.values["Rows"]), int(self.values["Columns"])))
        surface_m = 3e-9 * (np.sin(x_m / 40e-9) + np.sin(y_m / 70e-9 + x_m / 200e-9) ** 3)
        noise_m = np.random.default_rng().normal(0.0, 5e-11, x_m.shape)
        np.savez(
            self.folder / f"scan{len(list(self.folder.iterdir())):04}.npz",
            height_m=surface_m + noise_m,
            frame_m=(x, y, width, height),
            angle_rad=angle_rad,
            time_ns=int(ended_s * 1e9),
        )
