"""The facts that a client must report about a packet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from afspm import wire
from afspm.basics.plain_data import Plain
from afspm.model import Packet, Scan, ScanLines, Spectrum
from afspm.testing.conformance import Failed, near

EXACT = 1e-9
Facts = Plain


def facts_of(packet: Packet) -> Facts:
    """Return the comparable facts of a packet."""
    message = wire.message_of(packet.envelope)
    facts: Facts = {"envelope": packet.envelope, "message": message, "timestamp_ns": packet.time_ns}
    if wire.declaration(message).has_values:
        facts |= _measured(wire.decode(message, packet.payload))
    return facts


def _measured(thing: object) -> Facts:
    match thing:
        case Spectrum():
            return {
                "kind": thing.kind,
                "names": list(thing.names),
                "units": list(thing.units),
                "position_m": None if thing.position_m is None else list(thing.position_m),
                "shape": list(thing.values.shape),
                "values": _values(thing.values),
            }
        case Scan() | ScanLines():
            return {
                "channel": thing.channel,
                "unit": thing.unit,
                "center_m": list(thing.region.center_m),
                "size_m": list(thing.region.size_m),
                "angle_deg": float(np.degrees(thing.region.angle_rad)),
                "shape": list(thing.shape if isinstance(thing, Scan) else thing.values.shape),
                "values": _values(thing.values),
            }
    raise TypeError(f"{type(thing).__name__} has no values")


def _values(values: NDArray[np.float64]) -> Facts:
    flat = values.ravel()
    if not flat.size:
        return {"count": 0, "first": None, "last": None, "sum": 0.0, "moment": 0.0}
    index = np.arange(flat.size, dtype=np.float64)
    return {
        "count": int(flat.size),
        "first": float(flat[0]),
        "last": float(flat[-1]),
        "sum": float(flat.sum()),
        "moment": float(index @ flat),
        "_scales": (float(np.abs(flat).sum()), float(index @ np.abs(flat))),
    }


def compare(reported: Facts, packet: Packet) -> None:
    """Compare a client's report of a packet with the packet. Raises Failed."""
    for name, right in facts_of(packet).items():
        came = reported.get(name)
        if name == "values":
            _compare_values(packet.envelope, right, came)
        elif not _same(right, came):
            raise Failed(f"{packet.envelope} with {name} = {right!r}", repr(came) if name in reported else "none")


def _compare_values(envelope: str, right: Facts, came: object) -> None:
    if not isinstance(came, dict):
        raise Failed(f"{envelope} with the facts of its values", repr(came))
    scales = right.get("_scales", (0.0, 0.0))
    for name, scale in (("sum", scales[0]), ("moment", scales[1])):
        if not _number(came.get(name)) or abs(came[name] - right[name]) > EXACT * scale:
            raise Failed(f"{envelope} with {name} = {right[name]!r}: all values, in their order", repr(came.get(name)))
    for name in ("count", "first", "last"):
        if not _same(right[name], came.get(name)):
            raise Failed(f"{envelope} with {name} = {right[name]!r} of its values", repr(came.get(name)))


def _same(right: object, came: object) -> bool:
    if isinstance(right, float):
        return _number(came) and near(right, float(came), EXACT, 1e-18)  # type: ignore[arg-type]
    if isinstance(right, list):
        return isinstance(came, list) and len(right) == len(came) and all(map(_same, right, came))
    return type(right) is type(came) and right == came


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
