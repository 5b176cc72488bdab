"""`DriftCompensatedScheduler`: a Scheduler with drift compensation (paper, "Drift Compensated Scheduler")."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from afspm import wire
from afspm.basics import NS_PER_S, ConfigError, PlainMapping
from afspm.model import XY, Frame
from afspm.plugins.drift.frame.messages import Matrix, Registered, RescanWanted
from afspm.plugins.drift.frame.response import RESCAN
from afspm.plugins.drift.frame.sample_frame import SampleFrame
from afspm.plugins.drift.frame.scan_intake import MAPPING
from afspm.plugins.drift.frame.settings import DriftCompensationSettings
from afspm.plugins.drift.frame.worker import DriftWorkerInProcess
from afspm.plugins.drift.frame.worker_process import DriftWorkerProcess
from afspm.scheduler import Coordinates, Scheduler, WireCodec
from afspm.transport import ProcessContext
from afspm.wire import timestamp
from afspm.wire.messages import DriftMapping, DriftRescan, ScanParameters2d


class DriftCompensatedScheduler(Scheduler):
    """A Scheduler that gives components sample coordinates, while the microscope works in tip coordinates.

    Drift is followed from scan to scan. Scans and spectra are published at their place on the sample, and requested
    places are sent to the microscope where they will be under the tip.

    A `DriftMapping` is published for each scan, and a `DriftRescan` requests a rescan from the component `Rescanner`.
    The scheduler flags thermal-drift when the sample is lost: its tracker reports so, three registrations in a row
    failed, or too many of the last ten scans were not registered. The flag also stands until the first scan was taken
    in both directions. Device-malfunction is flagged when no more scans will be registered; clearing this problem
    restarts the worker. Without correction, no problem is flagged, and components use tip coordinates.

    Args:
        drift: settings of drift tracking and correction.
        control, limits, cache, conditions: as for the Scheduler. Limits hold for requests to the microscope, in tip
            coordinates.
    """

    flags: ClassVar = ("thermal-drift", "device-malfunction")
    publishes: ClassVar = (MAPPING, RESCAN)
    plain_settings: ClassVar = ("drift",)
    needs_parameters: tuple[str, ...] = ()

    def __init__(
        self,
        drift: DriftCompensationSettings | None = None,
        control: PlainMapping | None = None,
        limits: PlainMapping | None = None,
        cache: PlainMapping | None = None,
        conditions: PlainMapping | None = None,
    ) -> None:
        super().__init__(control, limits, cache, conditions)
        self.drift = (
            DriftCompensationSettings.from_table(drift or {})
            if not isinstance(drift, DriftCompensationSettings)
            else drift
        )
        if (compensate := self.drift.compensate) is not None:
            self.needs_parameters = (compensate.x, compensate.y)

    @classmethod
    def frame_of(cls, settings: PlainMapping) -> Frame:
        """Return the coordinates of components with these settings: of the tip, if drift is never corrected."""
        drift: PlainMapping = settings.get("drift") or {}
        return Frame.SAMPLE if drift.get("correct", True) else Frame.TIP

    def check(self) -> None:
        """Check that estimator and tracker can be created and support these settings. Raises ConfigError if not."""
        from afspm.plugins.drift.estimators import estimator
        from afspm.plugins.drift.track import tracker

        made = tracker(self.drift.tracker, estimator(self.drift.estimator))
        if self.drift.compensate is not None and not hasattr(made, "compensated"):
            raise ConfigError(
                "this tracker can't follow a controller that compensates by itself",
                where="drift: compensate",
                hint='tracker = "bank", or leave compensate out',
            )

    def coordinates(self, context: ProcessContext, *, in_process: bool = False) -> Coordinates:
        launch = context.launch
        file = Path(launch.state_dir) / f"{launch.name}.drift.npz" if launch.state_dir else None
        drift = self.drift.beside(launch.solved)
        if drift != self.drift:
            context.log.info("no component solves thermal-drift: the first scan is not taken in both directions")
        frame = SampleFrame.initial(drift, DriftWireCodec(), launch.name)
        if in_process:
            return Coordinates(frame, DriftWorkerInProcess(drift, file, context.log))
        worker = DriftWorkerProcess(drift, file, context.log)
        worker.late = context.clock.late
        return Coordinates(frame, worker)


class DriftWireCodec(WireCodec):
    """Implementation of `DriftCodec` by afspm's wire format."""

    def relocated(self, message: str, payload: bytes | memoryview, told: bytes) -> bytes:
        of = "ProbePosition" if message in ("Spec1d", "ProbePosition") else "ScanParameters2d"
        return wire.relocated(message, payload, wire.place_in(of, told))

    def encode_mapping(
        self, registered: Registered, filename: str, center_m: XY, *, correcting: bool, channel: str | None
    ) -> bytes:
        return DriftMapping(
            timestamp=timestamp(round(registered.time_s * NS_PER_S)),
            matrix=_flat(registered.matrix[:2]),
            covariance=_flat(registered.covariance_m2),
            rate=registered.rate_m_s,
            rate_covariance=_flat(registered.rate_covariance),
            matched=registered.matched,
            lost=registered.lost,
            reason=registered.reason,
            residual=registered.residual_m,
            references=registered.references,
            filename=filename,
            center=center_m,
            correcting=correcting,
            rescan=registered.rescan,
            outcome=int(registered.outcome),  # type: ignore[arg-type]
            failures=len(registered.failures),
            channel=channel,
        ).SerializeToString()

    def encode_rescan(self, wanted: RescanWanted) -> bytes:
        params = ScanParameters2d.FromString(wanted.requested)
        if wanted.shape is not None:
            params.data.shape.y, params.data.shape.x = wanted.shape
        message = DriftRescan(
            timestamp=timestamp(wanted.time_ns),
            params=params,
            kind=int(wanted.kind),  # type: ignore[arg-type]
            reason=wanted.reason,
            upwards=wanted.upwards,
        )
        return message.SerializeToString()


def _flat(rows: Matrix) -> list[float]:
    return [value for row in rows for value in row]
