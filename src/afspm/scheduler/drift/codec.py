"""The wire, as far as drift compensation needs it."""

from __future__ import annotations

from afspm import wire
from afspm.clock import NS_PER_S
from afspm.model.geometry import XY
from afspm.scheduler.drift.messages import Matrix, Registered, RescanWanted
from afspm.scheduler.wire_codec import WireCodec
from afspm.wire.mapping import timestamp
from afspm.wire.messages import DriftMapping, DriftRescan, ScanParameters2d


class DriftWireCodec(WireCodec):
    """See `scheduler.drift.messages.DriftCodec`."""

    def relocated(self, message: str, payload: bytes | memoryview, told: bytes) -> bytes:
        of = "ProbePosition" if message in ("Spec1d", "ProbePosition") else "ScanParameters2d"
        return wire.relocated(message, payload, wire.place_in(of, told))

    def encode_mapping(self, registered: Registered, filename: str, center_m: XY, *, correcting: bool) -> bytes:
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
        ).SerializeToString()

    def encode_rescan(self, wanted: RescanWanted) -> bytes:
        params = ScanParameters2d.FromString(wanted.said)
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
