"""Conversion of model objects and messages to and from bytes, by the name of the message."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from google.protobuf.message import Message

from afspm import model
from afspm.basics.errors import AfspmError, InvalidValue, UnitError, WireError
from afspm.basics.formatting import counted
from afspm.basics.units import convert as convert_unit
from afspm.model.scan import ShapeChange
from afspm.wire import unit_conversion
from afspm.wire.generated import analysis_pb2, lines_pb2, scan_pb2, spectroscopy_pb2
from afspm.wire.mapping import MAPPINGS, MessageMapping, time_ns, timestamp
from afspm.wire.messages import message_type, parse
from afspm.wire.split import Buffer, doubles, nested, packed, split

_VALUES_OF_SCAN = _VALUES_OF_LINES = 4
_DATA_OF_SPECTRUM = 4
_VALUES_OF_DATA = 5
_MOST_VALUES = 8
_LONGEST_VALUE = 200
_LONGEST_TEXT = 1000


def as_plain(message: Any) -> Any:
    """Return a message of a generated class in JSON's types, by the names in its .proto file.

    A message with content that JSON can't have, such as a time after the year 9999, is returned as one text.
    """
    from google.protobuf.json_format import Error, MessageToDict  # slow to import, and rarely needed

    try:
        return MessageToDict(message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True)
    except (Error, TypeError, ValueError):
        return " ".join(str(message).split())


def as_text(message: Any) -> str:
    """Return a message of a generated class as "tilt_rad: 0.01, …" for people, in one line.

    Of long lists the first values are shown, of long texts the beginning, and of bytes their number.
    """
    plain = as_plain(message)
    if not isinstance(plain, dict):
        return _value_text(plain)
    names = [field.name for field in message.DESCRIPTOR.fields if field.name in plain]
    values = {name: getattr(message, name) for name in names}  # of bytes, JSON has a text
    shown = {name: value if isinstance(value, bytes) else plain[name] for name, value in values.items()}
    text = ", ".join(f"{name}: {_value_text(value)}" for name, value in shown.items())
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]} …"


def _value_text(value: object) -> str:
    match value:
        case dict():
            return "{" + ", ".join(f"{name}: {_value_text(one)}" for name, one in value.items()) + "}"
        case list():
            more = f", … {len(value)} values" if len(value) > _MOST_VALUES else ""
            return f"[{', '.join(map(_value_text, value[:_MOST_VALUES]))}{more}]"
        case bytes():
            return counted(len(value), "byte")
        case float():
            return f"{value:.10g}"  # without the rounding error of a calculation
        case str() if len(value) > _LONGEST_VALUE:
            return f"{value[:_LONGEST_VALUE]}… {len(value)} characters"
    return str(value)


def encode(thing: object) -> tuple[str, bytes]:
    """Return a model object or a message as (name of the message, bytes).

    Raises:
        InvalidValue: `thing` is neither a model object nor a message.
    """
    if isinstance(thing, Message):
        return _serialised(thing)
    encoder = _ENCODERS.get(type(thing))
    if encoder is None:
        raise InvalidValue(f"a {type(thing).__name__} can't be sent", hint="send a Scan, a Spectrum, … or a message")
    return encoder(thing)


def decode(name: str, payload: Buffer) -> Any:
    """Return the message `name` as a model object if it has one, else as the generated message.

    A scan's values are a view of `payload`, or a copy if the peer sent them in several pieces.

    Raises:
        WireError: the bytes are no such message, or hold invalid values.
    """
    decoder = _DECODERS.get(name)
    try:
        return parse(message_type(name), payload) if decoder is None else decoder(payload)
    except (InvalidValue, UnitError) as error:
        raise WireError(f"a {name} that makes no sense: {error}") from error


def header(name: str, payload: Buffer) -> model.PacketHeader:
    """Return the fields of a message that determine its envelope, and its time, without reading its values.

    Raises:
        WireError: the bytes are no such message.
    """
    reader = _HEADERS.get(name)
    if reader is None:
        message_type(name)
        return model.PacketHeader(name)
    try:
        return reader(payload)
    except AfspmError as error:
        raise WireError(f"a {name} that makes no sense: {error}") from error


def _encode_scan(scan: model.Scan) -> tuple[str, bytes]:
    message = scan_pb2.Scan2d(
        params=unit_conversion.scan_parameters_to_wire(scan.parameters),
        channel=scan.channel,
    )
    if scan.time_ns is not None:
        message.timestamp.CopyFrom(timestamp(scan.time_ns))
    if scan.filename:
        message.filename = scan.filename
    if not scan.values.size:
        return "Scan2d", message.SerializeToString()
    return "Scan2d", b"".join((message.SerializeToString(), *packed(scan.values, _VALUES_OF_SCAN)))


def _decode_scan(payload: Buffer) -> model.Scan:
    rest, chunks = split(payload, _VALUES_OF_SCAN)
    message = parse(scan_pb2.Scan2d, rest)
    values = doubles(chunks)
    shape = message.params.data.shape
    if values.size and values.size != shape.x * shape.y:
        raise WireError(f"a scan of {shape.x} x {shape.y} pixels with {values.size} values")
    region = unit_conversion.whole_region(unit_conversion.spatial_from_wire(message.params.spatial))
    if region is None:
        raise WireError("a scan without a place")
    return model.Scan(
        region,
        message.channel,
        message.params.data.units,
        values.reshape(shape.y, shape.x) if values.size else values.reshape(0, 0),
        time_ns(message.timestamp) if message.HasField("timestamp") else None,
        message.filename,
        None if values.size or not (shape.x and shape.y) else (shape.y, shape.x),
    )


def _scan_header(payload: Buffer) -> model.PacketHeader:
    # the values are cut out before parsing: a header costs the same for a scan of any size
    message = parse(scan_pb2.Scan2d, split(payload, _VALUES_OF_SCAN)[0])
    spatial = message.params.spatial
    size_m = None
    if spatial.roi.HasField("size"):
        unit = spatial.length_units or "m"
        size_m = (convert_unit(spatial.roi.size.x, unit, "m"), convert_unit(spatial.roi.size.y, unit, "m"))
    stamp = time_ns(message.timestamp) if message.HasField("timestamp") else None
    return model.PacketHeader("Scan2d", message.channel, size_m, None, stamp)


def _encode_lines(lines: model.ScanLines) -> tuple[str, bytes]:
    message = lines_pb2.ScanLines(
        params=unit_conversion.scan_parameters_to_wire(model.ScanParameters(lines.region, lines.shape, lines.unit)),
        channel=lines.channel,
        first_row=lines.first_row,
    )
    if lines.began_ns is not None:
        message.timestamp.CopyFrom(timestamp(lines.began_ns))
    return "ScanLines", b"".join((message.SerializeToString(), *packed(lines.values, _VALUES_OF_LINES)))


def _decode_lines(payload: Buffer) -> model.ScanLines:
    rest, chunks = split(payload, _VALUES_OF_LINES)
    message = parse(lines_pb2.ScanLines, rest)
    values, shape = doubles(chunks), message.params.data.shape
    region = unit_conversion.whole_region(unit_conversion.spatial_from_wire(message.params.spatial))
    if region is None or not shape.x or values.size % shape.x:
        raise WireError(f"{values.size} values are no lines of {shape.x} pixels of a scan with a known place")
    return model.ScanLines(
        region,
        (shape.y, shape.x),
        message.channel,
        message.params.data.units,
        message.first_row,
        values.reshape(-1, shape.x),
        time_ns(message.timestamp) if message.HasField("timestamp") else None,
    )


def _lines_header(payload: Buffer) -> model.PacketHeader:
    message = parse(lines_pb2.ScanLines, split(payload, _VALUES_OF_LINES)[0])
    return model.PacketHeader("ScanLines", message.channel)


def _encode_spectrum(spectrum: model.Spectrum) -> tuple[str, bytes]:
    message = spectroscopy_pb2.Spec1d(type=spectrum.kind)
    if spectrum.position_m is not None:
        message.position.CopyFrom(unit_conversion.position_to_wire(model.ProbePosition(spectrum.position_m)))
    if spectrum.filename:
        message.filename = spectrum.filename
    if spectrum.time_ns is not None:
        message.timestamp.CopyFrom(timestamp(spectrum.time_ns))
    data = spectroscopy_pb2.SpecData(
        num_variables=len(spectrum.names),
        data_per_variable=spectrum.values.shape[0],
        names=spectrum.names,
        units=spectrum.units,
    )
    # nested by hand: protobuf would copy the values into a list of Python floats
    inner = b"".join((data.SerializeToString(), *packed(spectrum.values, _VALUES_OF_DATA)))
    return "Spec1d", message.SerializeToString() + nested(inner, _DATA_OF_SPECTRUM)


def _decode_spectrum(payload: Buffer) -> model.Spectrum:
    rest, inner = split(payload, _DATA_OF_SPECTRUM)
    message = parse(spectroscopy_pb2.Spec1d, rest)
    data_rest, chunks = split(b"".join(inner), _VALUES_OF_DATA)
    data = parse(spectroscopy_pb2.SpecData, data_rest)
    values = doubles(chunks)
    if values.size != data.num_variables * data.data_per_variable:
        raise WireError(
            f"a spectrum of {data.num_variables} variables of {data.data_per_variable} values each with {values.size}"
        )
    position = unit_conversion.position_from_wire(message.position).xy_m if message.HasField("position") else None
    return model.Spectrum(
        position,
        message.type,
        tuple(data.names),
        tuple(data.units),
        values.reshape(data.data_per_variable, data.num_variables),
        time_ns(message.timestamp) if message.HasField("timestamp") else None,
        message.filename,
    )


def _spectrum_header(payload: Buffer) -> model.PacketHeader:
    message = parse(spectroscopy_pb2.Spec1d, split(payload, _DATA_OF_SPECTRUM)[0])
    stamp = time_ns(message.timestamp) if message.HasField("timestamp") else None
    return model.PacketHeader("Spec1d", kind=message.type, time_ns=stamp)


def _regions_header(payload: Buffer) -> model.PacketHeader:
    message = parse(analysis_pb2.SpatialROIWithScoreList, payload)
    return model.PacketHeader("SpatialROIWithScoreList", message.channel)


def _points_header(payload: Buffer) -> model.PacketHeader:
    message = parse(analysis_pb2.SpatialPointWithScoreList, payload)
    return model.PacketHeader("SpatialPointWithScoreList", message.channel)


def _serialised(message: Message) -> tuple[str, bytes]:
    return message.DESCRIPTOR.name, message.SerializeToString()


def _encode_mapped(mapping: MessageMapping[object], thing: object) -> tuple[str, bytes]:
    return _serialised(mapping.to_wire(thing))


def _published_parameters(payload: Buffer) -> model.ScanParameters:
    parameters = unit_conversion.scan_parameters_from_wire(parse(scan_pb2.ScanParameters2d, payload))
    if isinstance(parameters.region, model.RegionChange):  # published parameters are in force: no angle means unrotated
        whole = unit_conversion.whole_region(parameters.region)
        parameters = model.ScanParameters(whole or parameters.region, parameters.shape, parameters.unit)
    # a request may change one axis alone, but parameters in force have both
    if isinstance(parameters.shape, ShapeChange):
        raise WireError("scan parameters in force with pixels along one axis only")
    return parameters


_ENCODERS: dict[type, Callable[[Any], tuple[str, bytes]]] = {
    model.Scan: _encode_scan,
    model.ScanLines: _encode_lines,
    model.Spectrum: _encode_spectrum,
    model.ScanParameters: lambda thing: _serialised(unit_conversion.scan_parameters_to_wire(thing)),
    model.ProbePosition: lambda thing: _serialised(unit_conversion.position_to_wire(thing)),
    **{mapping.kind: partial(_encode_mapped, mapping) for mapping in MAPPINGS},
}

_DECODERS: dict[str, Callable[[Buffer], object]] = {
    "Scan2d": _decode_scan,
    "ScanLines": _decode_lines,
    "Spec1d": _decode_spectrum,
    "ScanParameters2d": _published_parameters,
    "ProbePosition": lambda payload: unit_conversion.position_from_wire(parse(spectroscopy_pb2.ProbePosition, payload)),
    **{mapping.name: mapping.decode for mapping in MAPPINGS},
}

_HEADERS: dict[str, Callable[[Buffer], model.PacketHeader]] = {
    "Scan2d": _scan_header,
    "ScanLines": _lines_header,
    "Spec1d": _spectrum_header,
    "SpatialROIWithScoreList": _regions_header,
    "SpatialPointWithScoreList": _points_header,
}
