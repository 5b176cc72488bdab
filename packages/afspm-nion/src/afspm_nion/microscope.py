"""Nion's instrument software in this process: its managers, its simulated microscope, and one scan at a time.

Nion's coordinates are (y, x) with y downwards, and a frame is its centre, its width and its number of pixels, which are
square. A scan is recorded on a thread of Nion's, which hands over its channels at the end.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from nion.instrumentation import HardwareSource, camera_base, scan_base, stem_controller
from nion.usim_device import DeviceConfiguration
from nion.utils import Geometry
from numpy.typing import NDArray

from afspm.model import Region

NM: Final = 1e-9


Counts = dict[str, NDArray[np.float32]]
"""The values of each channel of a scan, rows ascending with y."""


class SimulatedMicroscope:
    """Nion's simulated scanning transmission microscope, with its managers running.

    Only one can run in a process, since Nion's managers are the process's own.

    Args:
        folder: an existing folder for the settings that Nion saves.
    """

    def __init__(self, folder: Path) -> None:
        # By default, Nion's configuration deletes the folder "test_data" of the working folder.
        # Its first sample, flakes, is the only one whose picture moves as a whole with the frame.
        self._devices = DeviceConfiguration.AcquisitionContextConfiguration(set_configuration_location=False)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="nion", daemon=True)
        self._thread.start()
        HardwareSource.run()
        camera_base.run(folder)
        scan_base.run(folder)
        stem_controller.register_event_loop(self._loop)
        self._devices.run()
        manager = HardwareSource.HardwareSourceManager()
        found = manager.get_hardware_source_for_hardware_source_id(self._devices.scan_module.device.scan_device_id)
        # typed as any source: a scan source has more methods
        self._source: Any = found
        self._lock = threading.Lock()
        self._recorded: Counts | None = None
        self._number = 0

    @property
    def name(self) -> str:
        """The name and version of the microscope."""
        return f"{self._source.display_name} of nionswift-usim {version('nionswift-usim')}"

    @property
    def channels(self) -> list[str]:
        """The names of all detectors."""
        return [self._source.get_channel_name(index) for index in range(self._source.channel_count)]

    def move_stage(self, to_m: tuple[float, float]) -> None:
        """Put the stage, and with it the sample, at (x, y)."""
        x, y = to_m
        self._devices.instrument.stage_position_m = Geometry.FloatPoint(y=-y, x=x)

    def record(
        self, region: Region, shape: tuple[int, int], dwell_s: float, detectors: Sequence[str], done: Callable[[], None]
    ) -> None:
        """Start a scan with square pixels.

        Args:
            done: called on Nion's thread once the scan is over.
        """
        self._number += 1
        number = self._number
        names = self.channels
        self._source.set_enabled_channels([names.index(one) for one in detectors])
        parameters = frame_parameters(self._source.get_current_frame_parameters(), region, shape, dwell_s)

        def finished(promises: Sequence[Any]) -> None:
            # Nion calls this for an aborted scan, too.
            found = [one.xdata for one in promises]
            with self._lock:
                if number == self._number and all(one is not None for one in found):
                    self._recorded = {name: np.flipud(one.data) for name, one in zip(detectors, found, strict=True)}
            done()

        self._recorded = None
        self._source.start_recording(5.0, finished, frame_parameters=parameters)

    @property
    def is_recording(self) -> bool:
        return bool(self._source.is_recording)

    def take(self) -> Counts | None:
        """Return the channels of the scan that has ended, once; None without one."""
        with self._lock:
            recorded, self._recorded = self._recorded, None
        return recorded

    def stop(self) -> None:
        """End the scan at once; it has no result."""
        with self._lock:
            self._number += 1
            self._recorded = None
        self._source.abort_recording(5.0)

    def close(self) -> None:
        """Stop the managers."""
        self.stop()
        stem_controller.unregister_event_loop()
        self._devices.stop()
        scan_base.stop()
        camera_base.stop()
        HardwareSource.stop()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
        if self._thread.is_alive():
            logging.getLogger(__name__).warning("Nion's event loop did not stop within 5 s")


def frame_parameters(parameters: Any, region: Region, shape: tuple[int, int], dwell_s: float) -> Any:
    """Return Nion's parameters of a scan, changed from others of Nion's.

    A pixel of Nion's is an area, and a region reaches from the centre of the first pixel to the centre of the last. A
    frame that is not square is a part of a square one: Nion's simulation draws others in another scale than it says.
    """
    (x_m, y_m), (rows, columns) = region.center_m, shape
    most = max(rows, columns)
    pitch_m = region.size_m[0] / (columns - 1)
    parameters.pixel_size = Geometry.IntSize(most, most)
    parameters.fov_nm = pitch_m * most / NM
    parameters.center_nm = Geometry.FloatPoint(y=-y_m / NM, x=x_m / NM)
    parameters.rotation_rad = -region.angle_rad
    parameters.pixel_time_us = dwell_s * 1e6
    is_part = rows != columns
    parameters.subscan_pixel_size = Geometry.IntSize(rows, columns) if is_part else None
    parameters.subscan_fractional_size = Geometry.FloatSize(rows / most, columns / most) if is_part else None
    parameters.subscan_fractional_center = Geometry.FloatPoint(0.5, 0.5) if is_part else None
    return parameters
