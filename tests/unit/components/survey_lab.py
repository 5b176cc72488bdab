"""A laboratory in memory whose sample has particles."""

from __future__ import annotations

from typing import Any

import numpy as np
from client_lab import Lab

from afspm.model import ControlRequest, ControlResponse, Region, Request, Response, Scan, ScanParameters

PARTICLES = {(-1.0e-6, 0.5e-6): 90e-9, (1.2e-6, -0.8e-6): 120e-9, (0.3e-6, 1.4e-6): 60e-9}
"""Place and height."""
WIDTH_M = 70e-9


class ParticleLab(Lab):
    """Scans show `PARTICLES`; zooms about places with x above `limit_m` are refused (`zoom_alone`: never the survey).

    Attributes:
        regions: of the finished scans.
        spots: of the spectra.
    """

    def __init__(self, limit_m: float = 1.0, *, zoom_alone: bool = False) -> None:
        super().__init__("survey")
        self.limit_m, self.zoom_alone = limit_m, zoom_alone
        self.spots: list[tuple[float, float]] = []
        self.intercept = self._limited

    def _limited(self, request: Request) -> Response | str | None:
        wanted: Any = request.subject
        is_beyond = (
            request.kind == ControlRequest.SET_SCAN_PARAMS
            and isinstance(wanted, ScanParameters)
            and isinstance(wanted.region, Region)
            and wanted.region.center_m[0] > self.limit_m
            and not (self.zoom_alone and not self.finished)
        )
        if is_beyond:
            return Response(ControlResponse.PARAM_ERROR, reason="the region leaves the limits")
        return "go on"

    def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        x_m, y_m = region.pixels_m(shape)
        values = np.random.default_rng(len(self.finished)).normal(0.0, 0.3e-9, shape)
        for (x, y), height in PARTICLES.items():
            values += height * np.exp(-((x_m - x) ** 2 + (y_m - y) ** 2) / (2 * WIDTH_M**2))
        for channel in self.channels:
            name = f"scan-{len(self.finished)}.nc"
            self.publish(Scan(region, channel, "m", values, self.clock.now_ns(), name))

    def finish_spectrum(self) -> None:
        self.spots.append(self.position.xy_m)
        super().finish_spectrum()


__all__ = ["PARTICLES", "ParticleLab"]
