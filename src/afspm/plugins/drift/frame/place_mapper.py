"""Mapping of requests and packets between components (sample coordinates) and microscope (tip coordinates)."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping as Table
from dataclasses import dataclass, field, fields

from afspm.basics import AfspmError, InvalidValue, position_text
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Packet,
    PacketHeader,
    Parameter,
    PositionChange,
    ProbePosition,
    Region,
    RegionChange,
    Request,
    Response,
    ScanParameters,
    names,
)
from afspm.plugins.drift.frame.positions import (
    PlaceCodec,
    PositionPair,
    TargetPosition,
    away_m,
    in_reported_unit,
    is_same,
    value_in,
)
from afspm.plugins.drift.frame.scan_timing import ScanDurations
from afspm.plugins.drift.track.mapping import Mapping
from afspm.scheduler import PROBE_CHANGES, REGION_CHANGES, MappedRequest, number_of, scan_values
from afspm.wire.messages import PROBE_POSITION, SCAN_LINES, SCAN_PARAMETERS, SPECTRUM

MOVES_PX = 0.01
"""Offset in tip coordinates, in pixels, above which a region is set again before its scan."""
MOVES_M = 1e-11
"""The same bound for the probe, and for a region of unknown shape: finer than any scanner's positioning."""

_REMEMBERED = 64
_SET_SCAN, _SET_PROBE = int(ControlRequest.SET_SCAN_PARAMS), int(ControlRequest.SET_PROBE_POS)
_PARAM = int(ControlRequest.PARAM)
_MESSAGES = {_SET_SCAN: "ScanParameters2d", _SET_PROBE: "ProbePosition"}

MappingAt = Callable[[float], Mapping | None]
"""Mapping from tip to sample coordinates at an experiment time in s; None while components use tip coordinates."""


@dataclass(frozen=True)
class SavedPlace:
    """Saved form of a `PositionPair`: its two messages."""

    requested: bytes
    sent: bytes


@dataclass(frozen=True)
class MappedBefore:
    """The mapped form of an earlier request, so that a repeated request is sent unchanged."""

    kind: int
    place: SavedPlace
    payload: bytes


@dataclass(frozen=True)
class Places:
    """Scan region and probe position set at the microscope, in sample and tip coordinates.

    Attributes:
        shape: current (rows, columns); None if unknown.
        upwards: current direction of the slow axis; None if unknown.
        durations: durations of earlier scans, for the middle of the next scan.
        remembered: mapped forms of earlier requests, by client and id.
    """

    region: TargetPosition[Region] = field(default_factory=TargetPosition)
    probe: TargetPosition[ProbePosition] = field(default_factory=TargetPosition)
    shape: tuple[int, int] | None = None
    upwards: bool | None = None
    durations: ScanDurations = field(default_factory=ScanDurations)
    remembered: Table[str, MappedBefore] = field(default_factory=dict)


@dataclass(frozen=True)
class SavedPlaces:
    """Saved form of `Places`, for a restart after a kill."""

    region: SavedPlace | None
    probe: SavedPlace | None
    shape: tuple[int, int] | None
    upwards: bool | None
    durations: ScanDurations
    remembered: Table[str, MappedBefore]

    @classmethod
    def of(cls, places: Places) -> SavedPlaces:
        region, probe = (
            None if one is None else SavedPlace(one.requested, one.sent)
            for one in (places.region.current, places.probe.current)
        )
        return cls(region, probe, places.shape, places.upwards, places.durations, places.remembered)

    def restored(self, codec: PlaceCodec) -> Places:
        """Return the restored `Places`. Raises ValueError for an unreadable place."""
        region = None if self.region is None else _saved_region(codec, self.region)
        probe = None if self.probe is None else _saved_probe(codec, self.probe)
        return Places(
            TargetPosition(region), TargetPosition(probe),
            self.shape, self.upwards, self.durations, self.remembered,
        )  # fmt: skip


_PARTS = tuple(one.name for one in fields(Places))


class PlaceMapper:
    """Mutable copy of `Places` during one step of the mapping.

    Args:
        mapping_at: mapping at a time, from the current drift forecast.
    """

    region: TargetPosition[Region]
    probe: TargetPosition[ProbePosition]
    shape: tuple[int, int] | None
    upwards: bool | None
    durations: ScanDurations
    remembered: Table[str, MappedBefore]

    def __init__(self, places: Places, codec: PlaceCodec, mapping_at: MappingAt) -> None:
        self.__dict__.update(places.__dict__)
        self._codec = codec
        self._mapping_at = mapping_at

    def finish(self) -> Places:
        return Places(**{name: self.__dict__[name] for name in _PARTS})

    # --- requests ---

    def in_force(self, place: Region | ProbePosition, now_ns: int) -> None:
        mapping = self._mapping_at(now_ns * 1e-9)
        if isinstance(place, Region):
            if (known := self.region.published(place)) is None:
                region = place if mapping is None else mapping.to_sample(place)
                requested, sent = (self._codec.encode(ScanParameters(one)) for one in (region, place))
                known = self.region.at(PositionPair(region, requested, place, sent))
            self.region = known
            return
        if (known_probe := self.probe.published(place)) is None:
            probe = place if mapping is None else _position(mapping, place.xy_m)
            pair = PositionPair(probe, self._codec.encode(probe), place, self._codec.encode(place))
            known_probe = self.probe.at(pair)
        self.probe = known_probe

    def outgoing(self, who: str, request: Request, now_ns: int) -> MappedRequest | Response | None:
        now_s = now_ns * 1e-9
        mapping = self._mapping_at(now_s)
        change = _place_of(request)
        if mapping is None or change is None:
            return None
        key = f"{who} {request.id}"
        if request.id and (known := self.remembered.get(key)) is not None:
            return self._again(known, request)
        asks = isinstance(request.subject, Parameter) and request.subject.value is None
        try:
            if isinstance(change, PositionChange | ProbePosition):
                sample: Region | ProbePosition = self._position_after(change)
            else:
                sample = self._region_after(change)
        except AfspmError as error:
            return Response(int(ControlResponse.PARAM_ERROR), b"", str(error), request.id)
        if asks:
            return None  # its answer will be mapped
        return self._mapped(key, request, sample, now_s)

    def _mapped(self, key: str, request: Request, sample: Region | ProbePosition, now_s: float) -> MappedRequest:
        # a request for a part of a place (its x, its width) becomes the whole place: rotation mixes the parts
        kind, asked = (_SET_SCAN if isinstance(sample, Region) else _SET_PROBE), request.subject
        rest = asked if isinstance(asked, ScanParameters) else ScanParameters()
        is_whole = isinstance(asked, ProbePosition) or isinstance(rest.region, Region)
        place, subject = self._to_tip(sample, request.payload if is_whole else None, rest, now_s)
        payload = self._codec.encode(subject)
        if request.id:
            newest = MappedBefore(kind, SavedPlace(place.requested, place.sent), payload)
            self.remembered = dict([*self.remembered.items(), (key, newest)][-_REMEMBERED:])
        return MappedRequest(Request(kind, subject, payload, request.id), _names(asked), _both_places(place))

    def _again(self, known: MappedBefore, request: Request) -> MappedRequest:
        place: PositionPair[Region] | PositionPair[ProbePosition]
        if known.kind == _SET_SCAN:
            place = _saved_region(self._codec, known.place)
            self.region = self.region.sending(place)
        else:
            place = _saved_probe(self._codec, known.place)
            self.probe = self.probe.sending(place)
        subject = self._codec.decode_packet(_MESSAGES[known.kind], known.payload)
        return MappedRequest(
            Request(known.kind, subject, known.payload, request.id), _names(request.subject), _both_places(place)
        )

    def move_before(self, action: str, now_ns: int) -> MappedRequest | None:
        now_s = now_ns * 1e-9
        if self._mapping_at(now_s) is None:
            return None
        here: PositionPair[Region] | PositionPair[ProbePosition] | None = None
        if action == names.START_SCAN:
            here = self.region.current
        elif action in names.AT_PROBE:
            here = self.probe.current
        if here is None:
            return None
        sample = here.sample
        there = self._region_at_tip(sample, now_s) if isinstance(sample, Region) else self._probe_at_tip(sample, now_s)
        if away_m(there, here.tip) <= self._tolerance_m(here.tip):
            return None
        place, subject = self._to_tip(here.sample, here.requested, ScanParameters(), now_s)
        kind = _SET_SCAN if isinstance(place.tip, Region) else _SET_PROBE
        return MappedRequest(Request(kind, subject, place.sent), (), _both_places(place))

    def _region_at_tip(self, sample: Region, now_s: float) -> Region:
        # a scan that begins now is placed for its middle
        middle_s = now_s + self.durations.expected_s(self.shape, sample.size_m) / 2
        return (self._mapping_at(middle_s) or Mapping.identity()).to_tip(sample)

    def _probe_at_tip(self, sample: ProbePosition, now_s: float) -> ProbePosition:
        x, y = (self._mapping_at(now_s) or Mapping.identity()).inverse.apply(sample.xy_m)
        return ProbePosition((float(x), float(y)))

    def _to_tip(
        self, sample: Region | ProbePosition, requested: bytes | None, rest: ScanParameters, now_s: float
    ) -> tuple[PositionPair[Region] | PositionPair[ProbePosition], object]:
        if isinstance(sample, Region):
            region = self._region_at_tip(sample, now_s)
            subject = ScanParameters(region, rest.shape, rest.unit)
            if requested is None:
                requested = self._codec.encode(ScanParameters(sample))
            region_place = PositionPair(sample, requested, region, self._codec.encode(subject))
            self.region = self.region.sending(region_place)
            return region_place, subject
        tip = self._probe_at_tip(sample, now_s)
        requested = self._codec.encode(sample) if requested is None else requested
        probe_place = PositionPair(sample, requested, tip, self._codec.encode(tip))
        self.probe = self.probe.sending(probe_place)
        return probe_place, tip

    def _tolerance_m(self, tip: Region | ProbePosition) -> float:
        if isinstance(tip, ProbePosition) or self.shape is None:
            return MOVES_M
        rows, columns = self.shape
        pixel_m = min(tip.size_m[0] / max(columns - 1, 1), tip.size_m[1] / max(rows - 1, 1))
        return MOVES_PX * pixel_m

    def _region_after(self, change: Region | RegionChange) -> Region:
        if isinstance(change, Region):
            return change
        if self.region.current is None:
            raise AfspmError(
                "the microscope has not reported its scan region, so a part of it can't be mapped; set the whole region"
            )
        return change.onto(self.region.current.sample)

    def _position_after(self, change: ProbePosition | PositionChange) -> ProbePosition:
        if isinstance(change, ProbePosition):
            return change
        if self.probe.current is None:
            raise AfspmError(
                "the microscope has not reported its probe position, so a part of it can't be mapped; set x and y"
            )
        x_m, y_m = self.probe.current.sample.xy_m
        return ProbePosition((x_m if change.x_m is None else change.x_m, y_m if change.y_m is None else change.y_m))

    # --- what the microscope answers ---

    def carried_out(self, sent: Request, reported: Parameter | None, now_ns: int) -> None:
        if sent.kind == _SET_SCAN:
            self.region = self.region.was_set(sent.payload)
            if isinstance(sent.subject, ScanParameters) and isinstance(sent.subject.shape, tuple):
                self.shape = sent.subject.shape
        elif sent.kind == _SET_PROBE:
            self.probe = self.probe.was_set(sent.payload)
        elif isinstance(sent.subject, Parameter):
            parameter = reported or sent.subject
            if parameter.name == names.SCAN_SPEED and sent.subject.value is not None:
                self.durations = ScanDurations()
            elif parameter.name == names.SCAN_DIRECTION and parameter.value is not None:
                self.upwards = {names.UP: True, names.DOWN: False}.get(parameter.value)

    def answer(self, asked: Request, reported: Parameter | None, now_ns: int) -> Parameter | None:
        subject, mapping = asked.subject, self._mapping_at(now_ns * 1e-9)
        if mapping is None or not isinstance(subject, Parameter) or _place_of(asked) is None:
            return None
        if subject.value is not None:
            return subject  # set with the whole place, whose answer has no value
        tip_value = None if reported is None else number_of(reported)
        if tip_value is None:
            return None
        sample_value = self._in_sample(subject.name, tip_value, mapping)
        return None if sample_value is None else in_reported_unit(subject.name, sample_value, reported)

    def _in_sample(self, name: str, tip_value: float, mapping: Mapping) -> float | None:
        if name in PROBE_CHANGES:
            position = self.probe.current
            if position is None:
                return None
            axis = int(name == names.PROBE_POS_Y)
            xy_m = [position.tip.xy_m[0], position.tip.xy_m[1]]
            xy_m[axis] = tip_value
            if is_same(ProbePosition((xy_m[0], xy_m[1])), position.tip):
                return position.sample.xy_m[axis]
            return float(mapping.apply(xy_m)[axis])
        region = self.region.current
        if region is None:
            return None
        try:
            tip = REGION_CHANGES[name](tip_value).onto(region.tip)
        except InvalidValue:  # the microscope reports no valid region: its value is passed on unchanged
            return None
        return value_in(name, region.sample if is_same(tip, region.tip) else mapping.to_sample(tip))

    # --- packets ---

    def incoming(self, packet: Packet, header: PacketHeader, now_ns: int) -> Packet:
        handler = {
            SCAN_PARAMETERS.name: self._map_region,
            PROBE_POSITION.name: self._map_probe,
            SPECTRUM.name: self._map_spectrum,
            SCAN_LINES.name: self._map_lines,
        }.get(header.message)
        if handler is None:
            return packet
        message = self._codec.decode_packet(header.message, packet.payload)
        payload = handler(message, packet.payload, (header.time_ns or now_ns) * 1e-9)
        return packet if payload is None else Packet(packet.envelope, payload, packet.time_ns)

    def _map_region(self, message: object, payload: bytes | memoryview, time_s: float) -> bytes | None:
        if not isinstance(message, ScanParameters) or not isinstance(message.region, Region):
            return None
        if isinstance(message.shape, tuple):
            self.shape = message.shape
        mapping, known = self._mapping_at(time_s), self.region.published(message.region)
        if known is None or mapping is None:
            sample = message.region if mapping is None else mapping.to_sample(message.region)
            place = PositionPair(sample, self._codec.encode(ScanParameters(sample)), message.region, bytes(payload))
            known = self.region.at(place)
        self.region = known
        if mapping is None or known.current is None:
            return None
        return self._codec.relocated("ScanParameters2d", payload, known.current.requested)

    def _map_lines(self, message: object, payload: bytes | memoryview, time_s: float) -> bytes | None:
        # lines get the place of the frame in force; the finished scan will get its measured place
        region, mapping = getattr(message, "region", None), self._mapping_at(time_s)
        if region is None or mapping is None:
            return None
        known = self.region.published(region)
        if known is None or known.current is None:
            requested = self._codec.encode(ScanParameters(mapping.to_sample(region)))
        else:
            self.region, requested = known, known.current.requested
        return self._codec.relocated("ScanLines", payload, requested)

    def _map_probe(self, message: object, payload: bytes | memoryview, time_s: float) -> bytes | None:
        if not isinstance(message, ProbePosition):
            return None
        mapping, known = self._mapping_at(time_s), self.probe.published(message)
        if known is None or mapping is None:
            sample = message if mapping is None else _position(mapping, message.xy_m)
            known = self.probe.at(PositionPair(sample, self._codec.encode(sample), message, bytes(payload)))
        self.probe = known
        if mapping is None or known.current is None:
            return None
        return self._codec.relocated("ProbePosition", payload, known.current.requested)

    def _map_spectrum(self, message: object, payload: bytes | memoryview, time_s: float) -> bytes | None:
        # mapped for its own time: the sample may have drifted since the probe was moved
        mapping, position_m = self._mapping_at(time_s), getattr(message, "position_m", None)
        if mapping is None or position_m is None:
            return None
        return self._codec.relocated("Spec1d", payload, self._codec.encode(_position(mapping, position_m)))


def _saved_region(codec: PlaceCodec, saved: SavedPlace) -> PositionPair[Region]:
    sample, tip = (codec.decode_packet(_MESSAGES[_SET_SCAN], part) for part in (saved.requested, saved.sent))
    if not (isinstance(sample, ScanParameters) and isinstance(tip, ScanParameters)):
        raise ValueError("a place in force that can't be read")
    if isinstance(sample.region, Region) and isinstance(tip.region, Region):
        return PositionPair(sample.region, saved.requested, tip.region, saved.sent)
    raise ValueError("a place in force that can't be read")


def _saved_probe(codec: PlaceCodec, saved: SavedPlace) -> PositionPair[ProbePosition]:
    sample, tip = (codec.decode_packet(_MESSAGES[_SET_PROBE], part) for part in (saved.requested, saved.sent))
    if isinstance(sample, ProbePosition) and isinstance(tip, ProbePosition):
        return PositionPair(sample, saved.requested, tip, saved.sent)
    raise ValueError("a place in force that can't be read")


def _place_of(request: Request) -> Region | RegionChange | ProbePosition | PositionChange | None:
    subject = request.subject
    if request.kind == _SET_SCAN and isinstance(subject, ScanParameters):
        return subject.region
    if request.kind == _SET_PROBE and isinstance(subject, ProbePosition | PositionChange):
        return subject
    if request.kind != _PARAM or not isinstance(subject, Parameter):
        return None
    if subject.name not in REGION_CHANGES and subject.name not in PROBE_CHANGES:
        return None
    value = 1.0 if subject.value is None else number_of(subject)
    if value is None:
        return None  # the limits will refuse it with the reason
    return REGION_CHANGES[subject.name](value) if subject.name in REGION_CHANGES else PROBE_CHANGES[subject.name](value)


def _names(asked: object) -> tuple[str, ...]:
    if isinstance(asked, Parameter):
        return (asked.name,)
    if isinstance(asked, ScanParameters):
        return tuple(name for name, _ in scan_values(asked))
    if isinstance(asked, PositionChange):
        return (names.PROBE_POS_X,) if asked.y_m is None else (names.PROBE_POS_Y,)
    return (names.PROBE_POS_X, names.PROBE_POS_Y)


def _both_places(place: PositionPair[Region] | PositionPair[ProbePosition]) -> str:
    def centre(where: Region | ProbePosition) -> str:
        x, y = where.center_m if isinstance(where, Region) else where.xy_m
        return position_text((x, y))

    return f"that is {centre(place.tip)} at the tip, requested at {centre(place.sample)} on the sample"


def _position(mapping: Mapping, xy_m: tuple[float, float]) -> ProbePosition:
    x, y = mapping.apply(xy_m)
    return ProbePosition((float(x), float(y)))
